"""`iscat species`: which species any table of events holds, and how samples differ."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from iscat_cli.console import (
    Messages,
    failures,
    print_json,
    print_result,
    short,
    table,
    with_options,
)
from iscat_cli.options import CalibrationOption, JsonOption, OverwriteOption, command, frame_range
from iscat_cli.tables import AboveOption, LimitOption, SigmaOption, numbers, pair, whole

if TYPE_CHECKING:
    from iscat_analysis.answers.kinetics import Kinetics
    from iscat_analysis.species import Comparison, Distribution
    from iscat_analysis.species.tables import EventTable

EXAMPLE = """Example: as many species as there are; oligomers of a monomer near 66 kDa.

    iscat species standards.iscat

    iscat species standards.iscat/fits.csv --ladder 66 --out oligomers

Compare samples with the first.

    iscat species standards.iscat standards.iscat/fits.csv --k 3
"""


class Side(StrEnum):
    """Which events."""

    MAGNITUDE = "magnitude"
    LANDING = "landing"
    LEAVING = "leaving"


class Width(StrEnum):
    """How species share their width."""

    COMMON = "common"
    FREE = "free"


@command
def species(
    messages: Messages,
    events: Annotated[
        list[Path],
        typer.Argument(
            metavar="EVENTS",
            help="Output folder of iscat fit, fits.csv or .parquet, a table of Refeyn's or for "
            "PhotoMol (h5, csv; FILE::movie is one of several movies), or any CSV with a column "
            "mass_kda or Mass [kDa]. Of several, the others are compared with the first.",
        ),
    ],
    *,
    k: Annotated[
        int | None,
        typer.Option(
            "--k", metavar="N", help="Number of species; default the number with the smallest BIC."
        ),
    ] = None,
    masses: Annotated[
        str | None,
        typer.Option(
            "--masses", metavar="M1,M2", help="Masses of the species, which are fixed [kDa]."
        ),
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(
            "--start",
            metavar="M1,M2",
            help="Masses from which the fit of as many species begins [kDa]; they are free.",
        ),
    ] = None,
    ladder: Annotated[
        str | None,
        typer.Option(
            "--ladder",
            metavar="M1",
            help=(
                "Species are oligomers of a monomer of about this mass [kDa], which is "
                "fitted; auto finds it."
            ),
        ),
    ] = None,
    steps: Annotated[
        str | None,
        typer.Option(
            "--steps", metavar="N1,N2", help="Which oligomers, as in 1,2,4; default those found."
        ),
    ] = None,
    offset: Annotated[
        bool, typer.Option("--offset", help="Fit an offset common to all oligomers.")
    ] = False,
    hold: Annotated[
        bool, typer.Option("--hold", help="Fix the mass of the monomer at the one given.")
    ] = (False),
    widths: Annotated[
        Width | None,
        typer.Option(
            "--widths",
            help=(
                "With --masses and --ladder: a width for each species (default), or one for all."
            ),
        ),
    ] = None,
    background: Annotated[
        bool,
        typer.Option(
            "--background/--no-background",
            help=(
                "With --masses and --ladder: whether a broad, weak background of other masses"
                " is fitted."
            ),
        ),
    ] = True,
    side: Annotated[
        Side,
        typer.Option(
            "--branch",
            help=(
                "Events to use: all, by the magnitude of their mass, or only those that land or "
                "leave."
            ),
        ),
    ] = Side.MAGNITUDE,
    sigma: SigmaOption = None,
    limit: LimitOption = None,
    above: AboveOption = None,
    calibration: CalibrationOption = None,
    frame_rate: Annotated[
        float | None,
        typer.Option(
            "--frame-rate",
            metavar="HZ",
            help=(
                "Frames per second, for rates of landing and leaving; default from the "
                "configuration beside the table."
            ),
        ),
    ] = None,
    frames: Annotated[
        str | None,
        typer.Option(
            "--frames",
            metavar="A:B",
            help="Frames in which events were looked for, for the rates; default from the first "
            "to the last event.",
        ),
    ] = None,
    draws: Annotated[
        int,
        typer.Option(
            "--draws", metavar="N", help="Number of simulated repetitions for the intervals."
        ),
    ] = 100,
    seed: Annotated[int, typer.Option("--seed", metavar="N", help="Seed of the repetitions.")] = 1,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder for species.csv, species.json and a figure."),
    ] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Find the species of any table of events, each event with its own error.

    Fractions are of the particles that came, corrected for those that were too light to be seen.
    Of several tables: are they one sample, and if not, how do masses and fractions differ?
    """
    with failures(messages):
        middle, spread = pair("--limit", limit)
        given = None if masses is None else numbers("--masses", masses)
        begun = None if start is None else numbers("--start", start)
        rungs = () if steps is None else whole("--steps", steps)
        monomer = _monomer(ladder)
        if len(events) > 1:
            _only_one(
                offset=offset, hold=hold, side=side, widths=widths, start=start is not None,
                rates=frame_rate is not None or frames is not None,
            )  # fmt: skip
            _compare(
                messages, events, k, given, monomer, rungs, background=background,
                sigma=sigma, limit=(middle, spread), above=above, calibration=calibration, out=out,
                overwrite=overwrite, as_json=as_json,
            )  # fmt: skip
            return

        from iscat_analysis.answers.species import find_species
        from iscat_analysis.species.tables import event_table

        notes: list[str] = []
        events_of = event_table(
            events[0], sigma_kda=sigma, limit_kda=middle, limit_sigma_kda=spread, above_kda=above,
            calibration=calibration,
        )  # fmt: skip
        rates = _rates(events[0], events_of, frame_rate, frames)
        found = find_species(
            events_of,
            k=k,
            masses_kda=given,
            start_kda=begun,
            ladder=monomer,
            steps=rungs,
            offset=offset,
            hold=hold,
            widths="free" if widths is None else widths.value,
            background=background,
            branch=side.value,
            kinetics=rates,
            draws=draws,
            seed=seed,
            out=out,
            overwrite=overwrite,
            notify=notes.append,
        )
        if as_json:
            values = {"source": str(events[0]), **found.to_dict(), "notes": notes}
            if rates is not None:
                values["kinetics"] = rates.to_dict()
            print_json("species", values | ({} if out is None else {"out": str(out)}))
        else:
            _print(found)
            if rates is not None:
                _print_rates(rates)
        for note in notes:
            messages.notify(with_options(note))
        if out is not None:
            messages.notify(f"wrote {out}; look at {out / 'figures' / 'species.png'}")


def _only_one(
    *, offset: bool, hold: bool, side: Side, widths: Width | None, start: bool, rates: bool
) -> None:
    """Refuse what has no meaning where tables are compared."""
    from iscat_analysis.errors import ConfigError

    for option, given in (
        ("--offset", offset),
        ("--hold", hold),
        ("--branch", side is not Side.MAGNITUDE),
        ("--widths", widths is not None),
        ("--start", start),
        ("--frame-rate", rates),
    ):
        if given:
            raise ConfigError(
                f"{option} is for a single table; where tables are compared all masses and widths "
                "are free, and there are no rates: leave it out"
            )


def _compare(
    messages: Messages,
    events: list[Path],
    k: int | None,
    masses: list[float] | None,
    monomer: float | Literal["auto"] | None,
    steps: Sequence[int],
    *,
    background: bool,
    sigma: float | None,
    limit: tuple[float | None, float | None],
    above: float | None,
    calibration: Path | None,
    out: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Compare tables with the first of them."""
    from iscat_analysis.answers.comparing import compare_tables, comparison_document

    notes: list[str] = []
    with messages.progress() as progress:
        found = compare_tables(
            events, k=k, masses_kda=masses, ladder=monomer, steps=steps,
            background=background, sigma_kda=sigma, limit_kda=limit[0], limit_sigma_kda=limit[1],
            above_kda=above, calibration=calibration, out=out, overwrite=overwrite,
            progress=progress, notify=notes.append,
        )  # fmt: skip
    names = [str(path) for path in events]
    if as_json:
        values = comparison_document(names[0], names[1:], found, notes)
        print_json("species_comparison", values | ({} if out is None else {"out": str(out)}))
    else:
        for name, one in zip(names[1:], found, strict=True):
            _print_comparison(name, names[0], one)
    for note in notes:
        messages.notify(with_options(note))
    if out is not None:
        messages.notify(f"wrote {out}; look at {out / 'figures' / 'comparison.png'}")


def _print_comparison(name: str, first: str, found: Comparison) -> None:
    print_result(
        f"{name} beside {first}: p = {short(found.same.p_value, 2)} that they are one, "
        f"{short(found.same_masses.p_value, 2)} that masses are the same, "
        f"{short(found.same_fractions.p_value, 2)} that fractions are"
    )
    shown = table("species [kDa]", "shift [kDa]", "95 %", "shift [%]", "95 %", "fraction",
                  "there", "difference [%]", "95 %")  # fmt: skip
    for row in found.species.to_dict("records"):
        shown.add_row(
            short(row["mass_kda"]),
            short(row["shift_kda"], 3),
            _interval(row["shift_low"], row["shift_high"], 3),
            short(row["shift_percent"], 3),
            _interval(row["shift_percent_low"], row["shift_percent_high"], 3),
            f"{100 * row['fraction']:.3g} %",
            f"{100 * row['fraction_other']:.3g} %",
            short(100 * row["difference"], 3),
            _interval(100 * row["difference_low"], 100 * row["difference_high"], 3),
        )
    print_result(shown)


def _monomer(text: str | None) -> float | Literal["auto"] | None:
    from iscat_analysis.errors import ConfigError

    if text is None or text == "auto":
        return "auto" if text else None
    try:
        return float(text)
    except ValueError:
        raise ConfigError(
            f"--ladder {text}: give the mass of the monomer in kDa, as in --ladder 66, or auto"
        ) from None


def _print(found: Distribution) -> None:
    first = "oligomer" if found.ladder is not None else "species"
    shown = table(
        first, "mass [kDa]", "95 %", "width", "events", "detected", "came", "fraction", "95 %"
    )
    for number, row in enumerate(found.species.to_dict("records"), start=1):
        if row.get("background"):
            shown.add_row("background", "–", "–", "–", short(row["count"]), "–", "–", "–", "–")
            continue
        undetectable = math.isnan(row["count_corrected"])
        shown.add_row(
            str(row.get("n", number)),
            short(row["mass_kda"]),
            "not determined" if undetectable else _interval(row["mass_low"], row["mass_high"]),
            short(row["width_kda"], 3),
            short(row["count"]),
            f"{100 * row['efficiency']:.3g} %",
            "–" if undetectable else short(row["count_corrected"]),
            "–" if math.isnan(row["fraction"]) else f"{100 * row['fraction']:.3g} %",
            _interval(100 * row["fraction_low"], 100 * row["fraction_high"], 3),
        )
    print_result(shown)
    ladder = found.ladder
    if ladder is not None:
        offset = ""
        if ladder.offset_kda:
            offset = f", offset {short(ladder.offset_kda, 3)} ± {short(ladder.offset_se, 2)} kDa"
        error = "held" if ladder.held else f"± {short(ladder.monomer_se, 2)} kDa"
        verdict = (
            "" if ladder.p_value != ladder.p_value else f"; p = {ladder.p_value:.2g} of a ladder"
        )
        print_result(f"monomer {short(ladder.monomer_kda, 5)} kDa ({error}){offset}{verdict}")


def _rates(
    path: Path, events: EventTable, frame_rate: float | None, frames: str | None
) -> Kinetics | None:
    """Fit rates where the frames per second are known."""
    from iscat_analysis.answers.kinetics import configured_frame_rate, fit_kinetics
    from iscat_analysis.errors import ConfigError

    between = None if frames is None else frame_range("--frames", frames)
    if frame_rate is None:
        frame_rate = configured_frame_rate(path)
        if frame_rate is None or events.frame[0] != events.frame[0]:
            if between is not None:
                raise ConfigError(
                    f"--frames {frames} is for rates, which need --frame-rate and a table with "
                    "frames"
                )
            return None
    return fit_kinetics(events, frame_rate_hz=frame_rate, frames=between)


def _print_rates(found: Kinetics) -> None:
    landing, leaving = found.landing, found.unbinding
    if landing.per_second == landing.per_second:
        print_result(
            f"landing {short(landing.per_second, 3)} /s in the beginning, of those seen (95 %: "
            f"{_interval(landing.per_second_low, landing.per_second_high, 3)}), depletion "
            f"{short(landing.depletion_per_s, 2)} /s ("
            f"{_interval(landing.depletion_low, landing.depletion_high, 2)}), p = "
            f"{short(landing.depletion_p, 2)} of a constant rate"
        )
    if leaving is not None:
        print_result(
            f"leaving {short(leaving.per_second, 3)} /s (95 %: "
            f"{_interval(leaving.per_second_low, leaving.per_second_high, 3)}), from "
            f"{leaving.pairs} pairs of {leaving.landings} landings; by chance "
            f"{leaving.chance_pairs}"
        )


def _interval(low: float, high: float, digits: int = 4) -> str:
    return "–" if low != low else f"{short(low, digits)} to {short(high, digits)}"
