"""`iscat species` and `iscat kd`: what tables of events say of species, and of their binding."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Unpack

from iscat_analysis.options import BindingOptions, CommonSpecies, SpeciesOptions, only, options_of
from iscat_cli.console import Messages, listing, short
from iscat_cli.options import Output, command, frame_range

if TYPE_CHECKING:
    from rich.console import RenderableType

    from iscat_analysis.answers.binding import Binding
    from iscat_analysis.answers.kinetics import Kinetics
    from iscat_analysis.species import Comparison, Distribution
    from iscat_analysis.species.tables import EventTable


@command
def species(
    messages: Messages,
    events: list[Path],
    *,
    frame_rate: float | None = None,
    frames: str | None = None,
    draws: int = 100,
    seed: int = 1,
    output: Output,
    **options: Unpack[SpeciesOptions],
) -> None:
    """Find the species of any table of events, each event with its own error.

    Fractions are of the particles that came, corrected for those that were too light to be seen.
    Of several tables: are they one sample, and if not, how do masses and fractions differ?

    Options
    -------
    EVENTS
        Output folder of iscat fit, fits.csv or .parquet, a table of Refeyn's or for PhotoMol (h5,
        csv; FILE::movie is one of several movies), or any CSV with a column mass_kda or Mass [kDa].
        Of several, the others are compared with the first.
    --frame-rate HZ
        Frames per second, for rates of landing and leaving; default from the configuration beside
        the table.
    --frames A:B
        Frames in which events were looked for, for the rates; default from the first to the last
        event.
    --draws N
        Number of simulated repetitions for the intervals.
    --seed N
        Seed of the repetitions.
    --out DIR
        Folder for species.csv, species.json and a figure.

    Example: as many species as there are; oligomers of a monomer near 66 kDa.

        iscat species standards.iscat

        iscat species standards.iscat/fits.csv --ladder 66 --out oligomers

    Compare samples with the first.

        iscat species standards.iscat standards.iscat/fits.csv --k 3
    """
    written: Any = {"out": output.out, "overwrite": output.overwrite}
    if len(events) > 1:
        _refuse_single(options, rates=frame_rate is not None or frames is not None)
        _compare(messages, events, output, only(CommonSpecies, options) | written)
        return

    from iscat_analysis.answers.species import find_species
    from iscat_analysis.options import EventOptions
    from iscat_analysis.species.tables import event_table

    events_of = event_table(events[0], **only(EventOptions, options))
    rates = _rates(events[0], events_of, frame_rate, frames)
    notes: list[str] = []
    found = find_species(
        events_of, **options, **written, kinetics=rates, draws=draws, seed=seed, notify=notes.append
    )
    values = {"source": str(events[0]), **found.to_dict(), "notes": notes}
    if rates is not None:
        values["kinetics"] = rates.to_dict()
    lines = [*_lines(found), *_rate_lines(rates)]
    messages.answer("species", values, lines, output.out, "species.html", notes=notes)


def _refuse_single(options: SpeciesOptions, *, rates: bool) -> None:
    """Refuse what has no meaning where tables are compared."""
    from iscat_analysis.errors import ConfigError

    given = ["--frame-rate"] if rates else []
    for name, option in options_of(SpeciesOptions).items():
        if name not in options_of(CommonSpecies) and options.get(name) != option.default:
            given.insert(0, option.flag)
    if given:
        raise ConfigError(
            f"{given[0]} is for a single table; where tables are compared all masses and widths "
            "are free, and there are no rates: leave it out"
        )


def _compare(messages: Messages, events: list[Path], output: Output, options: Any) -> None:
    """Compare tables with the first of them."""
    from iscat_analysis.answers.comparing import compare_tables, comparison_document

    notes: list[str] = []
    with messages.progress() as progress:
        found = compare_tables(events, **options, progress=progress, notify=notes.append)
    names = [str(path) for path in events]
    values = comparison_document(names[0], names[1:], found, notes)
    pairs = zip(names[1:], found, strict=True)
    lines = [line for name, one in pairs for line in _comparison_lines(name, names[0], one)]
    page = "comparison.html"
    messages.answer("species_comparison", values, lines, output.out, page, notes=notes)


def _comparison_lines(name: str, first: str, found: Comparison) -> Iterator[RenderableType]:
    yield (
        f"{name} beside {first}: p = {short(found.same.p_value, 2)} that they are one, "
        f"{short(found.same_masses.p_value, 2)} that masses are the same, "
        f"{short(found.same_fractions.p_value, 2)} that fractions are"
    )
    yield listing(
        found.species.to_dict("records"),
        "species [kDa] | shift [kDa] | 95 % | shift [%] | 95 % | fraction | there | "
        "difference | 95 %",
        "{mass_kda:.4g} | {shift_kda:.3g} | {shift_low:.3g} to {shift_high:.3g} | "
        "{shift_percent:.3g} | {shift_percent_low:.3g} to {shift_percent_high:.3g} | "
        "{fraction:.3g%} | {fraction_other:.3g%} | {difference:.3g%} | {difference_low:.3g%} "
        "to {difference_high:.3g%}",
    )


def _lines(found: Distribution) -> Iterator[RenderableType]:
    rows = []
    for number, row in enumerate(found.species.to_dict("records"), start=1):
        interval = f"{short(row['mass_low'])} to {short(row['mass_high'])}"
        if math.isnan(row["count_corrected"]):
            interval = "not determined"
        rows.append({"n": number, **row, "interval": interval})
        if row.get("background"):
            only_count = {"n": "background", "count": row["count"]}
            rows[-1] = dict.fromkeys(rows[-1]) | only_count
    first = "oligomer" if found.ladder is not None else "species"
    yield listing(
        rows,
        f"{first} | mass [kDa] | 95 % | width | events | detected | came | fraction | 95 %",
        "{n} | {mass_kda:.4g} | {interval} | {width_kda:.3g} | {count:.4g} | {efficiency:.3g%} | "
        "{count_corrected:.4g} | {fraction:.3g%} | {fraction_low:.3g%} to {fraction_high:.3g%}",
    )
    if (ladder := found.ladder) is not None:
        offset = f", offset {short(ladder.offset_kda, 3)} ± {short(ladder.offset_se, 2)} kDa"
        error = "held" if ladder.held else f"± {short(ladder.monomer_se, 2)} kDa"
        verdict = f"; p = {ladder.p_value:.2g} of a ladder"
        yield (
            f"monomer {short(ladder.monomer_kda, 5)} kDa ({error})"
            f"{offset if ladder.offset_kda else ''}"
            f"{'' if math.isnan(ladder.p_value) else verdict}"
        )


def _rates(
    path: Path, events: EventTable, frame_rate: float | None, frames: str | None
) -> Kinetics | None:
    """Fit rates where the frames per second are known."""
    from iscat_analysis.answers.kinetics import configured_frame_rate, fit_kinetics
    from iscat_analysis.errors import ConfigError

    between = frame_range("--frames", frames)
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


def _rate_lines(found: Kinetics | None) -> Iterator[str]:
    if found is None:
        return
    landing, leaving = found.landing, found.unbinding
    if landing.per_second == landing.per_second:
        yield (
            f"landing {short(landing.per_second, 3)} /s in the beginning, of those seen (95 %: "
            f"{_interval(landing.per_second_low, landing.per_second_high, 3)}), depletion "
            f"{short(landing.depletion_per_s, 2)} /s ("
            f"{_interval(landing.depletion_low, landing.depletion_high, 2)}), p = "
            f"{short(landing.depletion_p, 2)} of a constant rate"
        )
    if leaving is not None:
        yield (
            f"leaving {short(leaving.per_second, 3)} /s (95 %: "
            f"{_interval(leaving.per_second_low, leaving.per_second_high, 3)}), from "
            f"{leaving.pairs} pairs of {leaving.landings} landings; by chance "
            f"{leaving.chance_pairs}"
        )


def _interval(low: float, high: float, digits: int = 4) -> str:
    return "–" if low != low else f"{short(low, digits)} to {short(high, digits)}"


@command
def kd(
    messages: Messages,
    samples: Path,
    *,
    model: Literal["dimer", "ab"],
    output: Output,
    **options: Unpack[BindingOptions],
) -> None:
    """Fit an equilibrium constant to the events of a series of concentrations.

    All events of all tables together, corrected for detection and landing; the interval is that of
    the profile likelihood, and a test says whether the tables follow the equilibrium.

    Options
    -------
    SAMPLES.csv
        One row per table or movie: path, and concentration_nm, or a_nm and b_nm.
    --model
        dimer: 2 M = D with concentration_nm of monomers in all; ab: A + B = AB with a_nm and b_nm
        in all.
    --out DIR
        Folder for kd.csv, kd.json and kd.html.

    Example: series.csv has a row per table, columns path and concentration_nm.

        iscat kd series.csv --model dimer --masses 66
    """
    from iscat_analysis.answers.binding import fit_kd

    found = fit_kd(samples, model=model, **options, out=output.out, overwrite=output.overwrite)
    values = {"source": str(samples), **found.to_dict()}
    lines, page = _binding_lines(found), "kd.html"
    messages.answer("kd", values, lines, output.out, page, notes=found.notes)


def _binding_lines(found: Binding) -> Iterator[RenderableType]:
    columns = [c for c in ("concentration_nm", "a_nm", "b_nm") if c in found.samples]
    headings = " | ".join(name.replace("_nm", " [nM]") for name in columns)
    totals = " | ".join(f"{{{name}:.4g}}" for name in columns)
    what = "dimers" if found.model == "dimer" else "AB"
    yield listing(
        found.samples.to_dict("records"),
        f"table | {headings} | events | {what} | 95 % | by K_D | pull | background",
        f"{{path}} | {totals} | {{events}} | {{complexes:.3g%}} | "
        "{complexes_low:.3g%} to {complexes_high:.3g%} | {predicted:.3g%} | {pull:+.1f} | "
        "{background:.2g%}",
    )
    fit = found.fit
    inert = ""
    if math.isfinite(fit.inactive_se):
        inert = f", inactive {100 * fit.inactive:.2g} ± {100 * fit.inactive_se:.1g} %"
    masses = ", ".join(short(mass) for mass in fit.masses_kda)
    yield (
        f"K_D = {short(fit.kd_nm)} nM (95 %: {short(fit.kd_low)} to {upper_end(fit.kd_high)} nM)"
        f"{inert}; species of {masses} kDa; p = {short(fit.p_value, 2)} of the equilibrium"
    )


def upper_end(value: float) -> str:
    """Write the upper end of an interval of K_D, which may be infinite."""
    return "∞" if value == float("inf") else short(value)
