"""Figures of Dong et al. (2021), in the authors' convention and exactly.

Everything arrives as tables; nothing is computed here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from iscat_analysis.records import FloatArray
from iscat_analysis.report.event_figures import HALO
from iscat_analysis.report.style import BLUE, GREY, INK, VERMILLION, log_y, new_figure

SCHEMES = {"iscat": "iSCAT", "cobri": "COBRI", "darkfield": "dark field"}
SCHEME_COLORS = {"iscat": BLUE, "cobri": VERMILLION, "darkfield": INK}
SHADES = ("#1B1D21", "#0072B2", "#009E73", "#D55E00", "#B5578C")


@dataclass(frozen=True)
class Panel:
    """How one of D21's panels is drawn."""

    title: str
    x_label: str
    y_label: str
    log: bool
    quantities: tuple[str, ...]
    bound: int | None = None
    by_attenuation: bool = False


_Z, _F = "height z [nm]", "focus height [nm]"
_MASS = "σ of mass / mass, one photon"
PANELS = {
    "2b": Panel("Fig. 2b: on-axis phase", _Z, "phase [rad]", False, ("phase",)),
    "2c": Panel("Fig. 2c: on-axis signal over noise", _Z, "SNR of one pixel, one photon", False,
                ("snr",)),
    "2d": Panel("Fig. 2d: transverse precision", _Z, "σ of x, one photon [nm]", True, ("x",), 0),
    "2e": Panel("Fig. 2e: axial precision", _Z, "σ of z, one photon [nm]", True, ("z",), 2),
    "3": Panel("Fig. 3: mass", _F, _MASS, True, ("mass", "mass joint"), 3),
    "4a": Panel("Fig. 4a: axial precision, COBRI attenuated", _Z, "σ of z, one photon [nm]", True,
                ("z",), 2, True),
    "4b": Panel("Fig. 4b: axial precision, iSCAT attenuated", _Z, "σ of z, one photon [nm]", True,
                ("z",), 2, True),
    "4c": Panel("Fig. 4c: mass, COBRI attenuated", _F, _MASS, True, ("mass",), 3, True),
    "4d": Panel("Fig. 4d: mass, iSCAT attenuated", _F, _MASS, True, ("mass",), 3, True),
}  # fmt: skip
"""D21's panels but 2a."""

QUANTITY_LABELS = {
    "x": "σ of x [nm]",
    "y": "σ of y [nm]",
    "z_iscat": "σ of z, iSCAT [nm]",
    "z_cobri": "σ of z, COBRI [nm]",
    "mass": "σ of mass / mass",
}
WAYS = {
    "printed": "printed",
    "authors": "authors' program",
    "dong2021": "their formulas, exact integrals",
    "exact": "exact",
    "reciprocal": "exact, energy conserved",
}


@dataclass(frozen=True)
class Curve:
    """One curve of a panel."""

    name: str
    x: FloatArray
    y: FloatArray
    color: str
    joint: bool


@dataclass(frozen=True)
class Limit:
    """A quantum bound, drawn across a panel."""

    name: str
    value: float
    color: str


def curves_of(panel: str, rows: pd.DataFrame, convention: str) -> list[Curve]:
    """Gather the curves of a panel."""
    spec, found = PANELS[panel], []
    rows = rows[(rows["convention"] == convention) & rows["quantity"].isin(spec.quantities)]
    keys = ["attenuation", "quantity"] if spec.by_attenuation else ["scheme", "quantity"]
    if spec.by_attenuation:
        rows = rows.sort_values("attenuation", ascending=False, kind="stable")
    for number, (key, group) in enumerate(rows.groupby(keys, sort=False)):
        first, quantity = key
        joint = str(quantity).endswith("joint")
        if joint and first != "iscat":
            continue  # as in D21; the CSV has all three
        if spec.by_attenuation and first == 0:
            name, color = "dark field", GREY
        elif spec.by_attenuation:
            name, color = f"β = {first:g}", SHADES[number]
        else:
            name, color = SCHEMES[first], SCHEME_COLORS[first]
        found.append(
            Curve(
                f"{name}, with z unknown" if joint else name,
                group["x"].to_numpy(float), group["value"].to_numpy(float), color, joint,
            )
        )  # fmt: skip
    return found


def limits_of(
    panel: str, quantum: Mapping[tuple[str, str], FloatArray], convention: str
) -> list[Limit]:
    """Gather the quantum bounds of a panel."""
    spec = PANELS[panel]
    if spec.bound is None:
        return []
    if spec.bound == 2:
        schemes = {"4a": ("cobri",), "4b": ("iscat",)}.get(panel, ("iscat", "cobri"))
        return [
            Limit(
                f"quantum bound, {SCHEMES[s]}",
                float(quantum[convention, s][2]),
                GREY if spec.by_attenuation else SCHEME_COLORS[s],
            )
            for s in schemes
        ]
    value = float(quantum[convention, "iscat"][spec.bound])
    return [Limit("quantum bound", value, GREY)]


def panel_figure(
    panel: str, rows: pd.DataFrame, quantum: Mapping[tuple[str, str], FloatArray]
) -> Figure:
    """Draw a panel, both conventions over each other, and below it how far they are apart."""
    spec = PANELS[panel]
    figure = new_figure(8.2, 4.8)
    top, low = figure.subplots(2, 1, sharex=True, height_ratios=[2.4, 1])
    for authors, exact in zip(
        curves_of(panel, rows, "dong2021"), curves_of(panel, rows, "exact"), strict=True
    ):
        style: dict[str, Any] = {"color": exact.color, "alpha": 0.55 if exact.joint else 1.0}
        top.plot(exact.x, exact.y, lw=1.6, label=exact.name, **style)
        top.plot(authors.x, authors.y, "--", lw=1.1, **style)
        apart = exact.y / authors.y if spec.log else exact.y - authors.y
        low.plot(exact.x, apart, lw=1.3, **style)
    for convention, dots in (("exact", (1.5, 2)), ("dong2021", (1.5, 6))):
        for limit in limits_of(panel, quantum, convention):
            label = limit.name if convention == "exact" else None
            top.axhline(limit.value, color=limit.color, lw=1.1, dashes=dots, label=label)
    handles, labels = top.get_legend_handles_labels()
    handles += [Line2D([], [], color=GREY), Line2D([], [], color=GREY, ls="--")]
    labels += ["exact", "authors' convention"]
    if spec.log:
        log_y(top)
    low.axhline(1.0 if spec.log else 0.0, color=GREY, lw=0.8)
    low.set(xlabel=spec.x_label, ylabel="exact / authors'" if spec.log else "exact − authors'")
    top.set_ylabel(spec.y_label)
    top.margins(x=0.01)
    figure.align_ylabels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure


def images_figure(images: Mapping[tuple[str, float], FloatArray], field_nm: float) -> Figure:
    """Draw figure 2a: one row per scheme, each with its own grey scale."""
    schemes = list(dict.fromkeys(scheme for scheme, _ in images))
    heights = list(dict.fromkeys(z for _, z in images))
    figure = new_figure(1.75 * len(heights) + 1.3, 1.75 * len(schemes) + 0.4)
    grid = figure.subplots(len(schemes), len(heights), squeeze=False)
    half = field_nm / 2000
    for row, scheme in enumerate(schemes):
        low = min(float(images[scheme, z].min()) for z in heights)
        high = max(float(images[scheme, z].max()) for z in heights)
        for column, z in enumerate(heights):
            axes = grid[row, column]
            shown = axes.imshow(
                images[scheme, z], cmap="gray", vmin=low, vmax=high, interpolation="nearest",
                extent=(-half, half, -half, half),
            )  # fmt: skip
            axes.set_xticks([])
            axes.set_yticks([])
            for spine in axes.spines.values():
                spine.set_visible(False)
            if row == 0:
                axes.set_title(f"z = {z / 1000:g} µm", loc="center")
        grid[row, 0].set_ylabel(SCHEMES[scheme])
        bar = figure.colorbar(shown, ax=grid[row, :], shrink=0.85, pad=0.01, aspect=14)
        bar.ax.ticklabel_format(axis="y", scilimits=(-2, 3))
        bar.outline.set_visible(False)
    grid[-1, 0].plot([-half + 0.3, -half + 1.3], [-half + 0.35] * 2, color="white", lw=2.5)
    grid[-1, 0].text(
        -half + 0.8, -half + 0.5, "1 µm", color="white", ha="center", va="bottom", fontsize=8,
        path_effects=HALO,
    )  # fmt: skip
    return figure


def table_figure(table: pd.DataFrame) -> Figure:
    """Draw Table 1."""
    figure = new_figure(7.4, 3.0)
    axes = figure.subplots()
    rows = table[table["unit"] == "nm"]
    marks = {"printed": ("s", GREY), "authors": ("x", GREY), "dong2021": ("+", INK),
             "exact": ("o", BLUE), "reciprocal": ("D", VERMILLION)}  # fmt: skip
    for number, (key, (mark, color)) in enumerate(marks.items()):
        at = np.arange(len(rows)) + 0.13 * (number - 2)
        axes.plot(rows[key], at, mark, color=color, label=WAYS[key], ms=6, mew=1.4)
    for y, (printed, exact) in enumerate(zip(rows["printed"], rows["exact"], strict=True)):
        axes.text(
            1.02, y, f"printed {printed:g}\nexact {exact:.1f}", va="center", fontsize=8,
            transform=axes.get_yaxis_transform(),
        )  # fmt: skip
    axes.set_yticks(range(len(rows)), [QUANTITY_LABELS[q].split(" [")[0] for q in rows["quantity"]])
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xlim(15, 150)
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5, 7)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("quantum bound of one collected photon [nm]")
    axes.grid(axis="x", color="#E7E4DD", lw=0.8)
    axes.set_axisbelow(True)
    figure.legend(loc="outside lower center", ncols=3, fontsize=8)
    return figure
