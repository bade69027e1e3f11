"""`iscat kd`: an equilibrium constant over a series of concentrations."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Unpack

from iscat_analysis.options import BindingOptions
from iscat_cli.console import Messages, listing, short
from iscat_cli.options import Output, command

if TYPE_CHECKING:
    from rich.console import RenderableType

    from iscat_analysis.answers.binding import Binding


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
        Folder for kd.csv, kd.json and a figure.

    Example: series.csv has a row per table, columns path and concentration_nm.

        iscat kd series.csv --model dimer --masses 66
    """
    from iscat_analysis.answers.binding import fit_kd

    found = fit_kd(samples, model=model, **options, out=output.out, overwrite=output.overwrite)
    values = {"source": str(samples), **found.to_dict()}
    folder, page = output.out, "figures/kd.png"
    messages.answer("kd", values, _lines(found), folder=folder, page=page, notes=found.notes)


def _lines(found: Binding) -> Iterator[RenderableType]:
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
