"""`iscat kd`: an equilibrium constant over a series of concentrations."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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
from iscat_cli.options import CalibrationOption, JsonOption, OverwriteOption, command
from iscat_cli.tables import AboveOption, LimitOption, SigmaOption, numbers, pair

if TYPE_CHECKING:
    from iscat_analysis.answers.binding import Binding

EXAMPLE = """Example: series.csv has a row per table, columns path and concentration_nm.

    iscat kd series.csv --model dimer --masses 66
"""


class Reaction(StrEnum):
    """Which reaction."""

    DIMER = "dimer"
    AB = "ab"


@command
def kd(
    messages: Messages,
    samples: Annotated[
        Path,
        typer.Argument(
            metavar="SAMPLES.csv",
            help="One row per table or movie: path, and concentration_nm, or a_nm and b_nm.",
        ),
    ],
    *,
    model: Annotated[
        Reaction,
        typer.Option(
            "--model",
            help="dimer: 2 M = D with concentration_nm of monomers in all; ab: A + B = AB with "
            "a_nm and b_nm in all.",
        ),
    ],
    masses: Annotated[
        str | None,
        typer.Option(
            "--masses",
            metavar="M | A,B",
            help=(
                "Approximate mass of the monomer, or of A and B [kDa], from which the fit "
                "starts. Without it the monomer is found from peaks at one mass and its "
                "double."
            ),
        ),
    ] = None,
    landing: Annotated[
        float | None,
        typer.Option(
            "--landing",
            metavar="P",
            help=(
                "Exponent P: the number of landings is proportional to concentration times "
                "mass^P. -0.167 out of a drop at rest onto an absorbing surface, -0.333 where"
                " liquid flows, 0 where all land alike; fitted, from -1/6 ± 1/6, unless "
                "given."
            ),
        ),
    ] = None,
    inactive: Annotated[
        bool,
        typer.Option(
            "--inactive", help="Fit the fraction of monomers, or of A, that does not bind."
        ),
    ] = False,
    sigma: SigmaOption = None,
    limit: LimitOption = None,
    above: AboveOption = None,
    calibration: CalibrationOption = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder for kd.csv, kd.json and a figure.")
    ] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Fit an equilibrium constant to the events of a series of concentrations.

    All events of all tables together, corrected for detection and landing; the interval is that of
    the profile likelihood, and a test says whether the tables follow the equilibrium.
    """
    with failures(messages):
        middle, spread = pair("--limit", limit)
        given = None if masses is None else numbers("--masses", masses)

        from iscat_analysis.answers.binding import fit_kd

        found = fit_kd(
            samples,
            model=model.value,
            masses_kda=given,
            landing_power=landing,
            inactive=inactive,
            sigma_kda=sigma,
            limit_kda=middle,
            limit_sigma_kda=spread,
            above_kda=above,
            calibration=calibration,
            out=out,
            overwrite=overwrite,
        )
        if as_json:
            values = {"source": str(samples), **found.to_dict()}
            print_json("kd", values | ({} if out is None else {"out": str(out)}))
        else:
            _print(found)
        for note in found.notes:
            messages.notify(with_options(note))
        if out is not None:
            messages.notify(f"wrote {out}; look at {out / 'figures' / 'kd.png'}")


def _print(found: Binding) -> None:
    columns = [c for c in ("concentration_nm", "a_nm", "b_nm") if c in found.samples]
    headings = [name.replace("_nm", " [nM]") for name in columns]
    what = "dimers" if found.model == "dimer" else "AB"
    shown = table("table", *headings, "events", what, "95 %", "by K_D", "pull", "background")
    for row in found.samples.to_dict("records"):
        shown.add_row(
            str(row["path"]),
            *(short(row[name]) for name in columns),
            str(row["events"]),
            f"{100 * row['complexes']:.3g} %",
            f"{100 * row['complexes_low']:.3g} to {100 * row['complexes_high']:.3g} %",
            f"{100 * row['predicted']:.3g} %",
            f"{row['pull']:+.1f}",
            f"{100 * row['background']:.2g} %",
        )
    print_result(shown)
    fit = found.fit
    inert = ""
    if fit.inactive_se == fit.inactive_se:
        inert = f", inactive {100 * fit.inactive:.2g} ± {100 * fit.inactive_se:.1g} %"
    masses = ", ".join(short(mass) for mass in fit.masses_kda)
    print_result(
        f"K_D = {short(fit.kd_nm)} nM (95 %: {short(fit.kd_low)} to {upper_end(fit.kd_high)} nM)"
        f"{inert}; species of {masses} kDa; p = {short(fit.p_value, 2)} of the equilibrium"
    )


def upper_end(value: float) -> str:
    """Write the upper end of an interval of K_D, which may be infinite."""
    return "∞" if value == float("inf") else short(value)
