"""Figures and pages of `iscat bounds`: scans, and Dong et al. (2021) beside the exact numbers.

Everything arrives as tables; nothing is computed here.
"""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

from iscat_analysis.records import PARAMETERS
from iscat_analysis.report.output import atomic_folder
from iscat_analysis.report.page import render_page
from iscat_analysis.report.tables import jsonable

FloatArray = NDArray[np.float64]

DPI = 140
"""Resolution of the PNG files."""

INK, BLUE, ORANGE, GREY = "#1B1D21", "#0072B2", "#D55E00", "#8A8F96"
SCHEMES = {"iscat": "iSCAT", "cobri": "COBRI", "darkfield": "dark field"}
SCHEME_COLORS = {"iscat": BLUE, "cobri": ORANGE, "darkfield": INK}
SCHEME_THEME = {"iscat": "qcrb", "cobri": "sigma", "darkfield": "ink"}
SHADES = ("#1B1D21", "#0072B2", "#009E73", "#D55E00", "#B5578C")
SHADE_THEME = ("ink", "qcrb", "ok", "sigma", "flag")
PARAMETER_LABELS = {"x_nm": "x [nm]", "y_nm": "y [nm]", "z_nm": "z [nm]", "mass_kda": "mass [kDa]"}
CONVENTIONS = {"dong2021": "Authors' convention", "exact": "Exact"}

_STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "iscat-analysis",
}


@dataclass(frozen=True)
class Panel:
    """How one of D21's panels is drawn.

    Attributes
    ----------
    title, x_label, y_label : str
        Words.
    log : bool
        Logarithmic y axis.
    quantities : tuple of str
        The quantities shown; the CSV has all.
    bound : int or None
        Index of the quantum bound drawn dashed.
    by_attenuation : bool
        Curves are attenuations of one scheme instead of schemes.
    """

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

PAPER_FILES = frozenset(
    {"comparison.html", "comparison.csv"}
    | {f"{stem}.{end}" for stem in [*(f"fig_{p}" for p in PANELS), "fig_2a", "table_1"]
       for end in ("png", "svg", "csv")}
)  # fmt: skip
"""What `write_paper` leaves in its folder."""

BOUNDS_FILES = frozenset({"bounds.json", "scan.csv", "scan.png", "scan.svg"})
"""What `write_bounds` may leave in its folder."""

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


def write_bounds(
    report: Mapping[str, Any],
    folder: Path,
    *,
    table: pd.DataFrame | None = None,
    label: str = "",
    here: float = float("nan"),
    overwrite: bool = False,
) -> Path:
    """Write the bounds of one experiment, and of a scan through it.

    Parameters
    ----------
    report : mapping
        What ``bounds.json`` holds.
    folder : Path
        Where to write.
    table : pandas.DataFrame, optional
        The scan: its axis first, then ``crb_single_*``, ``crb_joint_*``, ``qcrb_*`` and
        ``information_*`` for each parameter.
    label : str
        Name of the axis.
    here : float
        Where the experiment stands on it.
    overwrite : bool
        Whether an earlier result may be replaced.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    DataError
        The folder may not or cannot be written.
    """
    with atomic_folder(folder, overwrite, known=BOUNDS_FILES) as building:
        text = json.dumps(jsonable(report), indent=2, ensure_ascii=False, allow_nan=False)
        (building / "bounds.json").write_text(text + "\n", encoding="utf-8")
        if table is not None:
            table.to_csv(
                building / "scan.csv", index=False, float_format="%.9g", lineterminator="\n"
            )
            with mpl.rc_context(_STYLE):
                _save(scan_figure(table, label, here), building / "scan")
    return folder


def scan_figure(table: pd.DataFrame, label: str, here: float) -> Figure:
    """Draw bounds and used information along a scan.

    Parameters
    ----------
    table : pandas.DataFrame
        As in `write_bounds`.
    label : str
        Name of the axis.
    here : float
        Operating point; drawn where it lies inside the scan.

    Returns
    -------
    Figure
        Two rows: bounds, and the share of the light's information.
    """
    figure = Figure(figsize=(11, 5.4), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(2, 4, sharex=True, height_ratios=[1.7, 1])
    x = table.iloc[:, 0].to_numpy(float)
    for column, name in enumerate(PARAMETERS):
        top, low = grid[0, column], grid[1, column]
        styles = (
            ("crb_joint", "CRB, joint", INK, "-", 1.8),
            ("crb_single", "CRB, single", INK, ":", 1.2),
            ("qcrb", "QCRB", BLUE, "-", 1.8),
        )
        for kind, name_of, color, dash, width in styles:
            y = table[f"{kind}_{name}"].to_numpy(float)
            if np.isfinite(y).any():
                top.plot(x, y, dash, color=color, lw=width, label=name_of)
        _log(top)
        top.set_title(PARAMETER_LABELS[name])
        low.plot(x, 100 * table[f"information_{name}"].to_numpy(float), color=BLUE, lw=1.5)
        low.set_ylim(0, 100)
        low.set_xlabel(label)
        if x.min() <= here <= x.max():
            for axes in (top, low):
                axes.axvline(here, color=ORANGE, lw=1, dashes=(4, 3))
    if x.size > 1 and x.min() > 0 and x.max() / x.min() > 50:
        grid[0, 0].set_xscale("log")
    grid[0, 0].set_ylabel("standard deviation")
    grid[1, 0].set_ylabel("information used [%]")
    handles, labels = grid[0, 3].get_legend_handles_labels()
    for axes in grid[0]:
        more, names = axes.get_legend_handles_labels()
        if len(names) > len(labels):
            handles, labels = more, names
    if x.min() <= here <= x.max():
        handles, labels = (
            [*handles, *grid[1, 0].lines[-1:]],
            [*labels, f"configured: {here:g}".replace("-", "−")],
        )
    figure.legend(handles, labels, loc="outside upper center", ncols=4)
    return figure


def write_paper(
    curves: pd.DataFrame,
    images: Mapping[tuple[str, float], FloatArray],
    table: pd.DataFrame,
    quantum: Mapping[tuple[str, str], FloatArray],
    folder: Path,
    *,
    field_nm: float,
    overwrite: bool = False,
) -> Path:
    """Write every panel of D21, Table 1 and the page that compares them.

    Parameters
    ----------
    curves : pandas.DataFrame
        Long form: ``panel``, ``scheme``, ``convention``, ``attenuation``, ``quantity``, ``x``,
        ``value``.
    images : mapping
        (scheme, height [nm]) → intensity over the incident.
    table : pandas.DataFrame
        Table 1, one row per ``quantity``.
    quantum : mapping
        (measure, scheme) → quantum bounds of one photon.
    folder : Path
        Where to write.
    field_nm : float
        Side of the images [nm].
    overwrite : bool
        Whether an earlier result may be replaced.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    DataError
        The folder may not or cannot be written.
    """
    with (
        atomic_folder(folder, overwrite, known=PAPER_FILES) as building,
        mpl.rc_context(_STYLE),
    ):
        gallery = _images(images, field_nm)
        _save(gallery, building / "fig_2a")
        _images_table(images, field_nm).to_csv(
            building / "fig_2a.csv", index=False, float_format="%.5g", lineterminator="\n"
        )
        for panel in PANELS:
            rows = curves[curves["panel"] == panel]
            _save(_panel(panel, rows, quantum), building / f"fig_{panel}")
            rows.to_csv(
                building / f"fig_{panel}.csv",
                index=False, float_format="%.9g", lineterminator="\n",
            )  # fmt: skip
        _save(_table_figure(table), building / "table_1")
        for name in ("table_1.csv", "comparison.csv"):
            table.to_csv(building / name, index=False, float_format="%.9g", lineterminator="\n")
        picture = io.BytesIO()
        gallery.savefig(picture, format="png", dpi=110)
        page = render_page(
            "comparison.html",
            {
                "kicker": "iscat bounds",
                "title": "Dong et al. (2021), printed and exact",
                "subtitle": "Fundamental bounds on the precision of iSCAT, COBRI and dark-field "
                "microscopy, J. Phys. D 54, 394002: each number and each curve as its authors "
                "computed it, and as it comes out without the slips.",
                "sections": _sections(curves, table, quantum),
                "nav": [
                    ("table-1", "Table 1"),
                    *((f"figure-{n}", f"Figure {n}") for n in (2, 3, 4)),
                ],
                "picture": base64.b64encode(picture.getvalue()).decode("ascii"),
                "footer": "30 nm gold, 517.5 nm, NA 1.3, oil and glass 1.5, water 1.33; "
                "field of 4 × 4 µm.",
            },
        )
        (building / "comparison.html").write_text(page, encoding="utf-8")
    return folder


def _save(figure: Figure, stem: Path) -> None:
    figure.savefig(stem.with_suffix(".png"), dpi=DPI, pil_kwargs={"compress_level": 6})
    figure.savefig(stem.with_suffix(".svg"), metadata={"Date": None})


def _log(axes: Axes) -> None:
    """Set a logarithmic y axis with plain numbers."""
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    steps = {200.0: (1.0,), 20.0: (1.0, 2.0, 5.0), 4.0: (1.0, 2.0, 3.0, 5.0, 7.0)}
    finest = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0)
    subs = next((subs for span, subs in steps.items() if high / low > span), finest)
    axes.yaxis.set_major_locator(LogLocator(subs=subs))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


@dataclass(frozen=True)
class _Curve:
    name: str
    x: FloatArray
    y: FloatArray
    color: str
    theme: str
    dashed: bool


def _curves_of(panel: str, rows: pd.DataFrame, convention: str) -> list[_Curve]:
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
            name, color, theme = "dark field", GREY, "plain"
        elif spec.by_attenuation:
            name, color, theme = f"β = {first:g}", SHADES[number], SHADE_THEME[number]
        else:
            name, color, theme = SCHEMES[first], SCHEME_COLORS[first], SCHEME_THEME[first]
        found.append(
            _Curve(
                f"{name}, with z unknown" if joint else name,
                group["x"].to_numpy(float), group["value"].to_numpy(float), color, theme, joint,
            )
        )  # fmt: skip
    return found


def _limits(
    panel: str, convention: str, quantum: Mapping[tuple[str, str], FloatArray]
) -> list[tuple[str, float, str, str]]:
    """Quantum bounds of a panel: name, value, colour, theme colour."""
    spec = PANELS[panel]
    if spec.bound is None:
        return []
    if spec.bound == 2:
        schemes = {"4a": ("cobri",), "4b": ("iscat",)}.get(panel, ("iscat", "cobri"))
        return [
            (
                f"quantum bound, {SCHEMES[s]}", float(quantum[convention, s][2]),
                GREY if spec.by_attenuation else SCHEME_COLORS[s],
                "plain" if spec.by_attenuation else SCHEME_THEME[s],
            )
            for s in schemes
        ]  # fmt: skip
    return [("quantum bound", float(quantum[convention, "iscat"][spec.bound]), GREY, "plain")]


def _panel(panel: str, rows: pd.DataFrame, quantum: Mapping[tuple[str, str], FloatArray]) -> Figure:
    spec = PANELS[panel]
    figure = Figure(figsize=(9.2, 3.9), layout="constrained")
    FigureCanvasAgg(figure)
    both = figure.subplots(1, 2, sharey=True, sharex=True)
    for axes, (convention, title) in zip(both, CONVENTIONS.items(), strict=True):
        for c in _curves_of(panel, rows, convention):
            dash = (4, 2) if c.dashed else (None, None)
            axes.plot(c.x, c.y, color=c.color, lw=1.4, label=c.name, dashes=dash)
        for name, value, color, _ in _limits(panel, convention, quantum):
            axes.axhline(value, color=color, lw=1.1, dashes=(1.5, 2), label=name)
        axes.set_title(title)
        axes.set_xlabel(spec.x_label)
        axes.margins(x=0.01)
    if spec.log:
        _log(both[0])
    both[0].set_ylabel(spec.y_label)
    handles, labels = both[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(5, len(labels)))
    figure.suptitle(spec.title, x=0.01, ha="left", fontsize=11, fontweight="bold")
    return figure


def _images(images: Mapping[tuple[str, float], FloatArray], field_nm: float) -> Figure:
    schemes = list(dict.fromkeys(scheme for scheme, _ in images))
    heights = list(dict.fromkeys(z for _, z in images))
    figure = Figure(figsize=(1.75 * len(heights) + 1.3, 1.75 * len(schemes) + 0.4),
                    layout="constrained")  # fmt: skip
    FigureCanvasAgg(figure)
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
        -half + 0.8, -half + 0.5, "1 µm", color="white", ha="center", va="bottom", fontsize=8
    )
    return figure


def _images_table(images: Mapping[tuple[str, float], FloatArray], field_nm: float) -> pd.DataFrame:
    parts = []
    for (scheme, z), image in images.items():
        axis = (np.arange(image.shape[0]) - (image.shape[0] - 1) / 2) * field_nm / image.shape[0]
        part = pd.DataFrame(image, columns=[f"x={x:.2f}" for x in axis])
        part.insert(0, "y_nm", axis)
        part.insert(0, "z_nm", z)
        part.insert(0, "scheme", scheme)
        parts.append(part)
    return pd.concat(parts, ignore_index=True)


def _table_figure(table: pd.DataFrame) -> Figure:
    figure = Figure(figsize=(7.4, 3.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    rows = table[table["unit"] == "nm"]
    marks = {"printed": ("s", GREY), "authors": ("x", GREY), "dong2021": ("+", INK),
             "exact": ("o", BLUE), "reciprocal": ("D", ORANGE)}  # fmt: skip
    for number, (way, (mark, color)) in enumerate(marks.items()):
        at = np.arange(len(rows)) + 0.13 * (number - 2)
        axes.plot(rows[way], at, mark, color=color, label=WAYS[way], ms=6, mew=1.4)
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


def _sections(
    curves: pd.DataFrame,
    table: pd.DataFrame,
    quantum: Mapping[tuple[str, str], FloatArray],
) -> list[dict[str, Any]]:
    exact = table.set_index("quantity")["exact"]
    columns = [{"label": "Quantum bound of one photon"}] + [
        {"label": label, "numeric": True} for label in WAYS.values()
    ]
    rows = [
        [QUANTITY_LABELS[row["quantity"]], *(float(row[way]) for way in WAYS)]
        for _, row in table.iterrows()
    ]
    sections: list[dict[str, Any]] = [
        {
            "id": "table-1",
            "title": "Table 1",
            "lead": "Standard deviations for one collected scattered photon. The first two columns "
            "agree to the printed digits; the rest says what the formulas give when they are "
            "integrated exactly, and when the photons are counted as the camera counts them.",
            "facts": [
                {"label": "x", "value": f"{exact['x']:.1f}", "unit": "nm", "note": "printed: 71"},
                {"label": "y", "value": f"{exact['y']:.1f}", "unit": "nm", "note": "printed: 57"},
                {"label": "z, iSCAT", "value": f"{exact['z_iscat']:.1f}", "unit": "nm",
                 "note": "printed: 18"},
                {"label": "z, COBRI", "value": f"{exact['z_cobri']:.1f}", "unit": "nm",
                 "note": "printed: 114"},
            ],
            "tables": [{"columns": columns, "rows": rows, "caption": "Table 1, five ways"}],
            "notes": list(_NOTES),
        }
    ]  # fmt: skip
    sections.append(
        {"id": "figure-2", "title": "Figure 2a: images", "lead": _LEADS["2a"], "picture": True}
    )
    for panel, spec in PANELS.items():
        section: dict[str, Any] = {
            "id": {"3": "figure-3", "4a": "figure-4"}.get(panel, f"panel-{panel}"),
            "title": spec.title.replace("Fig. ", "Figure "),
            "charts": [
                _chart(panel, convention, curves[curves["panel"] == panel], quantum)
                for convention in CONVENTIONS
            ],
        }
        sections.append(section | ({"lead": _LEADS[panel]} if panel in _LEADS else {}))
    return sections


_NOTES = (
    "x and y: the number of photons in dθ dφ is |A|² sinθ; D21 squares the whole integrand of the "
    "field, sinθ √cosθ A, and so weighs the rim of the pupil too much.",
    "z in COBRI: the program drops n_s from the axial phase. The printed 114 nm is no bound: D21's "
    "own imaging model reaches 105 nm on this field, with the stage held.",
    "z in iSCAT: the same weight makes 18.2 nm of 17.8 nm.",
)
_LEADS = {
    "2a": "Detected over incident intensity, focus at 1 µm. D21 does not print its five heights; "
    "these show the rings on both sides of the focus, and a quarter of iSCAT's fringe from 0.95 "
    "to 1 µm. Each row has its own grey scale.",
    "2b": "Particle at height z, focus 1 µm above the coverslip for every z. Left as the authors "
    "computed it, here and below: per scattered photon on the field at z = focus = 0, refocusing "
    "while they differentiate. Right with the stage held, per collected photon. Dashed lines are "
    "the quantum bounds of the same convention.",
    "3": "Particle at 5 nm. Mass with everything else known, and for iSCAT with z unknown as well: "
    "in focus the image cannot tell height from mass.",
    "4a": "A weaker reference turns an interferometer into a dark-field microscope. β is the "
    "amplitude of the reference that passes.",
}


def _chart(
    panel: str,
    convention: str,
    rows: pd.DataFrame,
    quantum: Mapping[tuple[str, str], FloatArray],
) -> dict[str, Any]:
    spec = PANELS[panel]
    series: list[dict[str, Any]] = [
        {"kind": "line", "name": c.name, "color": c.theme, "x": c.x, "y": _digits(c.y),
         "dash": c.dashed}
        for c in _curves_of(panel, rows, convention)
    ]  # fmt: skip
    series += [
        {"kind": "rule", "name": name, "color": theme, "axis": "y", "value": value}
        for name, value, _, theme in _limits(panel, convention, quantum)
    ]
    y: dict[str, Any] = {"label": spec.y_label, "scale": "log" if spec.log else "linear"}
    y["domain"] = _shared_domain(panel, rows, quantum)
    return {
        "id": f"chart-{panel}-{convention}",
        "title": f"{CONVENTIONS[convention]}",
        "caption": None,
        "spec": {"x": {"label": spec.x_label}, "y": y, "height": 330, "series": series},
        "wide": False,
    }


def _digits(values: FloatArray) -> list[float]:
    return [float(f"{v:.6g}") for v in values]


def _shared_domain(
    panel: str, rows: pd.DataFrame, quantum: Mapping[tuple[str, str], FloatArray]
) -> Sequence[float]:
    """Return one y range for both conventions."""
    values = [c.y for convention in CONVENTIONS for c in _curves_of(panel, rows, convention)]
    values += [
        np.array([limit[1]]) for convention in CONVENTIONS
        for limit in _limits(panel, convention, quantum)
    ]  # fmt: skip
    every = np.concatenate(values)
    low, high = float(np.nanmin(every)), float(np.nanmax(every))
    if PANELS[panel].log:
        return [low / 1.1, high * 1.1]
    return [low - 0.05 * (high - low), high + 0.05 * (high - low)]
