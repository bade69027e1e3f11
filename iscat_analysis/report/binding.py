"""The figure of an equilibrium: complexes against concentration, and the profile of K_D.

Everything arrives as the document ``kd``; nothing is computed here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from iscat_analysis.report.numbers import number
from iscat_analysis.report.style import BLUE, GREY, INK, VERMILLION, new_figure

_DEVIANCE = 3.84  # of the ends of a 95 % interval


def binding_figure(found: Mapping[str, Any]) -> Iterator[tuple[str, Figure]]:
    """Draw fractions of complexes with their intervals, the equilibrium and the profile."""
    figure = new_figure(9.6, 3.6)
    left, right = figure.subplots(1, 2, width_ratios=(1.7, 1))
    rows = found["samples"]
    dimer = found["model"] == "dimer"
    at = np.array([row["concentration_nm"] if dimer else row["a_nm"] + row["b_nm"] for row in rows])
    share = np.array([row["complexes"] for row in rows], float)
    reach = np.array([[row["complexes"] - row["complexes_low"] for row in rows],
                      [row["complexes_high"] - row["complexes"] for row in rows]])  # fmt: skip
    order = np.argsort(at, kind="stable")
    side = np.ones(at.size)
    for value in np.unique(at):  # replicates beside each other
        same = np.flatnonzero(at == value)
        side[same] = 1 + 0.06 * (np.arange(same.size) - (same.size - 1) / 2)
    left.errorbar(
        at * side, share, yerr=reach, fmt="o", ms=4, lw=1, color=BLUE, label="tables, 95 %"
    )
    if dimer:
        curve = found["curve"]
        left.plot(
            curve["concentration_nm"], curve["complexes"], color=VERMILLION, label="equilibrium"
        )
    else:
        predicted = np.array([row["predicted"] for row in rows], float)
        left.plot(
            (at * side)[order], predicted[order], "_", ms=12, mew=1.6, color=VERMILLION,
            label="equilibrium",
        )  # fmt: skip
    left.set(
        xscale="log",
        ylim=(0, 1),
        xlabel="monomers in all [nM]" if dimer else "A and B in all [nM]",
        ylabel="dimers among the particles" if dimer else "AB among the particles",
    )
    left.legend(loc="upper left")
    kd = np.exp(np.array(found["profile"]["ln_kd_nm"], float))
    deviance = np.array(found["profile"]["deviance"], float)
    root = np.sign(np.log(kd / found["kd_nm"])) * np.sqrt(deviance)
    fine = np.linspace(np.log(kd[0]), np.log(kd[-1]), 100)
    if kd.size > 1:
        right.plot(np.exp(fine), np.interp(fine, np.log(kd), root) ** 2, color=INK)
    right.plot(kd, deviance, "o", ms=3.5, color=INK)
    right.axhline(_DEVIANCE, color=GREY, lw=0.8, ls="--")
    right.axvline(found["kd_nm"], color=VERMILLION, lw=1)
    right.set(
        xlabel="$K_D$ [nM]",
        ylabel="2 (largest log-likelihood − profile)",
        ylim=(0, 2.2 * _DEVIANCE),
        title=f"$K_D$ = {number(found['kd_nm'])} nM",
    )
    ends = [end for end in (found["kd_low"], found["kd_high"]) if end]
    if len(ends) == 2:
        right.set_xlim(ends[0] / (ends[1] / ends[0]) ** 0.5, ends[1] * (ends[1] / ends[0]) ** 0.5)
    yield "kd", figure
