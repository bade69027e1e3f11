"""What `iscat bounds` writes: one experiment and a scan, the optics, and Dong et al. (2021).

Everything arrives as reports and tables; nothing is computed here but what a figure needs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from iscat_analysis.bounds import PupilOptimum, plan, tradeoff
from iscat_analysis.config import SCHEMES, config_to_toml
from iscat_analysis.records import PARAMETERS, FloatArray
from iscat_analysis.report.numbers import LABELS, Fact, numeric, of, parameter, tabulate, worded
from iscat_analysis.report.output import atomic_folder
from iscat_analysis.report.page import Chart, Section, render_document
from iscat_analysis.report.style import (
    BLUE,
    GREY,
    GRID,
    HALO,
    INK,
    VERMILLION,
    Style,
    legend,
    new_figure,
    one_panel,
    picture,
    plain_log,
    publish,
)
from iscat_analysis.report.tables import write_csv, write_json

BOUNDS_FILES = frozenset(
    {"bounds.json", "scan.csv", "scan.png", "scan.svg", "tradeoff.png", "tradeoff.svg"}
    | {"optics.toml", "pupil.png", "pupil.svg"}
)
"""What `write_bounds` may leave in its folder."""

OPTICS_BOUNDS_FILES = frozenset({"optics_bounds.json", "needed.csv", "needed.png", "needed.svg"})
"""What `write_optics_bounds` leaves in its folder."""


def write_bounds(
    report: Mapping[str, Any],
    folder: Path,
    *,
    table: pd.DataFrame | None = None,
    label: str = "",
    here: float = float("nan"),
    design: PupilOptimum | None = None,
    overwrite: bool = False,
) -> Path:
    """Write the bounds of one experiment, and of a scan through it."""
    with atomic_folder(folder, overwrite, known=BOUNDS_FILES) as building:
        write_json("bounds", report, building / "bounds.json")
        if table is not None:
            write_csv(table, building / "scan.csv")
            publish(scan_figures(table, label, here), building)
        if design is not None:
            (building / "optics.toml").write_text(design_toml(design), encoding="utf-8")
            publish([("pupil", pupil_figure(design))], building)
        if {"z_nm", "mass_kda"} <= set(report["at"]["free"]):
            publish([("tradeoff", tradeoff_figure(report))], building)
    return folder


def design_toml(design: PupilOptimum) -> str:
    """Write the experiment with the best pupil."""
    config = design.config
    assumed = config.camera.assumed
    values = {key: getattr(assumed, key) for key in ("gain_e_per_adu", "offset_adu")}
    maps = {key: str(Path(v).resolve()) for key, v in values.items() if isinstance(v, str)}
    config = config.model_copy(update={"camera": config.camera.model_copy(update=maps)})
    sections = ("optics", "camera", "particle", "background", "fit", "bounds")
    return (
        "# The pupil with the smallest joint bound of "
        f"{', '.join(design.chosen)}: iscat bounds --optimize pupil.\n"
        f"# It takes {100 * design.shares['best']:.1f} % of what one measurement can take of the "
        "light.\n"
        "# As --config it gives the same bounds; as optics.file it gives the optics alone, and\n"
        "# bounds.photons_per_pixel must follow the attenuation squared.\n\n"
        + config_to_toml(config, comments=False, sections=sections)
    )


def pupil_figure(design: PupilOptimum) -> Figure:
    """Draw what the best pupil gives, and how a particle looks through it."""
    figure = new_figure(8.4, 3.6)
    left, right = figure.subplots(1, 2, width_ratios=[1.3, 1])
    at = np.arange(len(design.chosen))

    for kind, marker, color, label in (
        ("configured", "D", INK, "configured"),
        ("best", "D", VERMILLION, "best pupil"),
        ("holevo", "o", BLUE, "all at once, at best (Holevo)"),
    ):
        values = [each[kind] / each["qcrb"] for each in design.sigma.values()]
        left.plot(at, values, marker, color=color, label=label)
    left.axhline(1.0, color=BLUE, lw=1.2, ls="--", label="quantum bound of each alone")
    left.set_xticks(at, [LABELS[name] for name in design.chosen])
    left.set(xlim=(-0.5, at.size - 0.5), ylabel="σ over its own quantum bound")
    left.set_ylim(bottom=0.0)
    experiment = plan(design.config)
    x, y, z = (float(v) for v in experiment.theta[:3])
    image = experiment.model.image(experiment.grid, x, y, z, experiment.mass_kda)
    edge, half = float(np.abs(image).max()), float(np.ptp(experiment.grid.x_nm)) / 2e3
    picture(right, image, half, (-edge, edge), "contrast, best pupil")
    right.set(xlabel="x [µm]", ylabel="y [µm]")
    legend(figure, where="upper left")
    return figure


def tradeoff_figure(report: Mapping[str, Any]) -> Figure:
    """Draw how well one measurement can tell height and mass, and how well this microscope does."""
    information = np.asarray(report["qfi"]) + 1j * np.asarray(report["qfi_imaginary"])
    edge = tradeoff(information[2:, 2:])
    actual, both = report["actual"], report["holevo"]
    names = ("z_nm", "mass_kda")
    own = np.array([actual["qcrb"][name] for name in names])
    camera = np.array([actual["crb_joint"][name] for name in names])
    figure, axes = one_panel(5.2, 4.2)
    axes.axvline(own[0], color=BLUE, lw=1.2, ls="--", label="quantum bound of each alone")
    axes.axhline(own[1], color=BLUE, lw=1.2, ls="--")
    axes.plot(*edge.T, color=BLUE, lw=1.8, label="both at once, at best (Holevo)")
    axes.plot(both["z_nm"], both["mass_kda"], "o", color=BLUE, ms=5, label="with equal weights")
    if np.isfinite(camera).all():
        axes.plot(*camera, "D", color=VERMILLION, ms=6, label="this microscope, joint CRB")
    best = report.get("pupil", {}).get("sigma", {})
    if set(names) <= set(best):
        star: Style = {"color": VERMILLION, "ms": 10, "label": "with the best pupil"}
        axes.plot(*(best[name]["best"] for name in names), "*", **star)
    wide = np.nanmax(np.vstack([camera * 1.15, own * 2.2]), axis=0)
    axes.set(xlim=(0.8 * own[0], wide[0]), ylim=(0.8 * own[1], wide[1]))
    axes.set(xlabel="σ of height [nm]", ylabel="σ of mass [kDa]")
    legend(figure, where="upper left", columns=2)
    return figure


def write_optics_bounds(
    report: Mapping[str, Any], folder: Path, *, overwrite: bool = False
) -> Path:
    """Write how well particles would tell the microscope."""
    with atomic_folder(folder, overwrite, known=OPTICS_BOUNDS_FILES) as building:
        write_json("optics_bounds", report, building / "optics_bounds.json")
        write_csv(pd.DataFrame(report["needed"]), building / "needed.csv")
        publish(needed_figures(report), building)
    return folder


def needed_figures(report: Mapping[str, Any]) -> Iterator[tuple[str, Figure]]:
    """Draw how many particles of which mass the precisions take."""
    figure, axes = one_panel(6.4, 4.2)
    needed, goals = pd.DataFrame(report["needed"]), report["goals"]
    lines = (
        ("focus_nm", f"focus to {goals['focus_nm']:g} nm", BLUE, "-"),
        ("mass_rel", f"masses to {100 * goals['mass_rel']:g} %, in common", INK, "-"),
        ("identified", "everything identified", INK, ":"),
    )
    for column, label, color, dash in lines:
        style: Style = {"color": color, "ls": dash, "lw": 1.8, "ms": 4, "label": label}
        axes.plot(needed["mass_kda"], needed[column].astype(float), "o", **style)
    here = report["at"]["mass_kda"], report["events"]
    axes.plot(*here, "D", color=VERMILLION, ms=7, label="planned")
    axes.set(xscale="log", yscale="log", xlabel="mass [kDa]", ylabel="particles needed")
    axes.legend()
    yield "needed", figure


def scan_figures(table: pd.DataFrame, label: str, here: float) -> Iterator[tuple[str, Figure]]:
    """Draw bounds and used information along a scan."""
    figure = new_figure(11, 5.4)
    grid = figure.subplots(2, 4, sharex=True, height_ratios=[1.7, 1])
    x = table.iloc[:, 0].to_numpy(float)
    inside = x.min() <= here <= x.max()
    if x.size > 1 and x.min() > 0 and x.max() / x.min() > 50:
        grid[0, 0].set_xscale("log")
    for (top, low), name in zip(grid.T, PARAMETERS, strict=True):
        for kind, label_of, color, dash, width in (
            ("crb_joint", "CRB, joint", INK, "-", 1.8),
            ("crb_single", "CRB, single", INK, ":", 1.2),
            ("qcrb", "QCRB", BLUE, "-", 1.8),
        ):
            y = table[f"{kind}_{name}"].to_numpy(float)
            if np.isfinite(y).any():
                top.plot(x, y, dash, color=color, lw=width, label=label_of)
        plain_log(top, "y")
        top.set_title(parameter(name))
        low.plot(x, 100 * table[f"information_{name}"].to_numpy(float), color=BLUE, lw=1.5)
        low.set(ylim=(0, 100), xlabel=label)
        if inside:
            named = f"configured: {here:g}".replace("-", "−")
            low.axvline(here, color=VERMILLION, lw=1, dashes=(4, 3))
            top.axvline(here, color=VERMILLION, lw=1, dashes=(4, 3), label=named)
    grid[0, 0].set_ylabel("standard deviation")
    grid[1, 0].set_ylabel("information used [%]")
    legend(figure, where="upper center")
    yield "scan", figure


# ---- Dong et al. (2021) --------------------------------------------------------------------------

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
_AXIAL, _MASS = "σ of z, one photon [nm]", "σ of mass / mass, one photon"
_TWO = ("mass", "mass joint")
PANELS = {
    "2b": Panel("Fig. 2b: on-axis phase", _Z, "phase [rad]", False, ("phase",)),
    "2c": Panel("Fig. 2c: on-axis signal over noise", _Z, "SNR, one photon", False, ("snr",)),
    "2d": Panel("Fig. 2d: transverse precision", _Z, "σ of x, one photon [nm]", True, ("x",), 0),
    "2e": Panel("Fig. 2e: axial precision", _Z, _AXIAL, True, ("z",), 2),
    "3": Panel("Fig. 3: mass", _F, _MASS, True, _TWO, 3),
    "4a": Panel("Fig. 4a: axial precision, COBRI attenuated", _Z, _AXIAL, True, ("z",), 2, True),
    "4b": Panel("Fig. 4b: axial precision, iSCAT attenuated", _Z, _AXIAL, True, ("z",), 2, True),
    "4c": Panel("Fig. 4c: mass, COBRI attenuated", _F, _MASS, True, ("mass",), 3, True),
    "4d": Panel("Fig. 4d: mass, iSCAT attenuated", _F, _MASS, True, ("mass",), 3, True),
}
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

PAPER_FILES = frozenset(
    {"comparison.html", "comparison.csv"}
    | {
        f"{stem}.{end}"
        for stem in ("table_1", "fig_2a", *(f"fig_{panel}" for panel in PANELS))
        for end in ("png", "svg", "csv")
    }
)
"""What `write_paper` leaves in its folder."""

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
    "while they differentiate. Exact: the stage held, per collected photon. Solid curves are "
    "exact, dashed ones the authors'; dotted lines are quantum bounds. The lower panel shows how "
    "far the two are apart.",
    "3": "Particle at 5 nm. Mass with everything else known, and for iSCAT with z unknown as well: "
    "in focus the image cannot tell height from mass.",
    "4a": "A weaker reference turns an interferometer into a dark-field microscope. β is the "
    "amplitude of the reference that passes.",
}


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
    """Write every panel of D21, Table 1 and the page that compares them."""
    with atomic_folder(folder, overwrite, known=PAPER_FILES) as building:
        write_csv(_images_table(images, field_nm), building / "fig_2a.csv", 5)
        for panel in PANELS:
            write_csv(curves[curves["panel"] == panel], building / f"fig_{panel}.csv")
        for name in ("table_1.csv", "comparison.csv"):
            write_csv(table, building / name)
        drawn = publish(_paper_figures(curves, images, table, quantum, field_nm), building)
        bar = [("table-1", "Table 1"), *((f"figure-{n}", f"Figure {n}") for n in (2, 3, 4))]
        frame = {
            "kicker": "iscat bounds",
            "nav": bar,
            "footer": "30 nm gold, 517.5 nm, NA 1.3, oil and glass 1.5, water 1.33; "
            "field of 4 × 4 µm.",
        }
        page = render_document(
            "Dong et al. (2021), printed and exact",
            "Fundamental bounds on the precision of iSCAT, COBRI and dark-field microscopy, J. "
            "Phys. D 54, 394002: each number and each curve as its authors computed it, and as it "
            "comes out without the slips.",
            _sections(table, drawn),
            frame=frame,
        )
        (building / "comparison.html").write_text(page, encoding="utf-8")
    return folder


def _paper_figures(
    curves: pd.DataFrame,
    images: Mapping[tuple[str, float], FloatArray],
    table: pd.DataFrame,
    quantum: Mapping[tuple[str, str], FloatArray],
    field_nm: float,
) -> Iterator[tuple[str, Figure]]:
    """Draw every panel; a generator, so that `publish` draws in its own style."""
    yield "table_1", table_figure(table)
    yield "fig_2a", images_figure(images, field_nm)
    for panel in PANELS:
        yield f"fig_{panel}", panel_figure(panel, curves[curves["panel"] == panel], quantum)


def _images_table(images: Mapping[tuple[str, float], FloatArray], field_nm: float) -> pd.DataFrame:
    parts = []
    for (scheme, z), image in images.items():
        axis = (np.arange(image.shape[0]) - (image.shape[0] - 1) / 2) * field_nm / image.shape[0]
        place = pd.DataFrame({"scheme": scheme, "z_nm": z, "y_nm": axis})
        parts.append(place.join(pd.DataFrame(image, columns=[f"x={x:.2f}" for x in axis])))
    return pd.concat(parts, ignore_index=True)


def _sections(table: pd.DataFrame, drawn: Mapping[str, Markup]) -> list[Section]:
    exact = table.set_index("quantity")["exact"]
    printed = {"x": 71, "y": 57, "z_iscat": 18, "z_cobri": 114}
    columns = (
        worded("Quantum bound of one photon", lambda row: QUANTITY_LABELS[row["quantity"]]),
        *(numeric(label, of(key, float)) for key, label in WAYS.items()),
    )
    sections = [
        Section(
            "table-1",
            "Table 1",
            "Standard deviations for one collected scattered photon. The first two columns agree "
            "to the printed digits; the rest says what the formulas give when they are integrated "
            "exactly, and when the photons are counted as the camera counts them.",
            facts=[
                Fact(QUANTITY_LABELS[key][5:-5], f"{exact[key]:.1f}", "nm", f"printed: {value}")
                for key, value in printed.items()
            ],
            charts=[Chart("chart-1", "Five ways to compute Table 1", drawn["table_1"], wide=True)],
            tables=[tabulate(table.to_dict("records"), columns, "Table 1, five ways")],
            notes=_NOTES,
        )
    ]
    names = {"2a": "figure-2", "3": "figure-3", "4a": "figure-4"}
    titles = {"2a": "Fig. 2a: images", **{p: spec.title for p, spec in PANELS.items()}}
    for panel, title in titles.items():
        title = title.replace("Fig. ", "Figure ")
        subject = title.partition(": ")[2].capitalize()
        charts = [Chart(f"chart-{panel}", subject, drawn[f"fig_{panel}"], wide=True)]
        name = names.get(panel, f"panel-{panel}")
        sections.append(Section(name, title, _LEADS.get(panel, ""), charts=charts))
    return sections


def curves_of(panel: str, rows: pd.DataFrame, convention: str) -> list[tuple[pd.DataFrame, Style]]:
    """Gather the curves of a panel, and how each is drawn."""
    spec, found = PANELS[panel], []
    rows = rows[(rows["convention"] == convention) & rows["quantity"].isin(spec.quantities)]
    key = "attenuation" if spec.by_attenuation else "scheme"
    if spec.by_attenuation:
        rows = rows.sort_values("attenuation", ascending=False, kind="stable")
    shades = iter(SHADES)
    for (first, quantity), group in rows.groupby([key, "quantity"], sort=False):
        joint = str(quantity).endswith("joint")
        if joint and first != "iscat":
            continue  # as in D21; the CSV has all three
        if not spec.by_attenuation:
            name, color = SCHEMES[first].title, SCHEME_COLORS[first]
        else:
            name, color = (f"β = {first:g}", next(shades)) if first else ("dark field", GREY)
        name = f"{name}, with z unknown" if joint else name
        found.append((group, {"color": color, "alpha": 0.55 if joint else 1.0, "label": name}))
    return found


def limits_of(
    panel: str, quantum: Mapping[tuple[str, str], FloatArray], convention: str
) -> list[tuple[str, float, str]]:
    """Gather the quantum bounds of a panel: name, value and colour of each."""
    spec = PANELS[panel]
    if spec.bound is None:
        return []
    if spec.bound != 2:
        return [("quantum bound", float(quantum[convention, "iscat"][spec.bound]), GREY)]
    schemes = {"4a": ("cobri",), "4b": ("iscat",)}.get(panel, ("iscat", "cobri"))
    colors = dict.fromkeys(schemes, GREY) if spec.by_attenuation else SCHEME_COLORS
    return [
        (f"quantum bound, {SCHEMES[s].title}", float(quantum[convention, s][2]), colors[s])
        for s in schemes
    ]


def panel_figure(
    panel: str, rows: pd.DataFrame, quantum: Mapping[tuple[str, str], FloatArray]
) -> Figure:
    """Draw a panel, both conventions over each other, and below it how far they are apart."""
    spec = PANELS[panel]
    figure = new_figure(8.2, 4.8)
    top, low = figure.subplots(2, 1, sharex=True, height_ratios=[2.4, 1])
    both = (curves_of(panel, rows, convention) for convention in ("dong2021", "exact"))
    for (authors, _), (exact, style) in zip(*both, strict=True):
        theirs, ours = (curve["value"].to_numpy(float) for curve in (authors, exact))
        top.plot(exact["x"], ours, lw=1.6, **style)
        unnamed: Style = {**style, "label": None}
        top.plot(authors["x"], theirs, "--", lw=1.1, **unnamed)
        low.plot(exact["x"], ours / theirs if spec.log else ours - theirs, lw=1.3, **unnamed)
    for convention, dots in (("exact", (1.5, 2)), ("dong2021", (1.5, 6))):
        for name, value, color in limits_of(panel, quantum, convention):
            label = name if convention == "exact" else None
            top.axhline(value, color=color, lw=1.1, dashes=dots, label=label)
    handles, labels = top.get_legend_handles_labels()
    handles += [Line2D([], [], color=GREY), Line2D([], [], color=GREY, ls="--")]
    labels += ["exact", "authors' convention"]
    if spec.log:
        plain_log(top, "y")
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
            style: Style = {"cmap": "gray", "vmin": low, "vmax": high}
            extent = (-half, half, -half, half)
            shown = axes.imshow(images[scheme, z], interpolation="nearest", extent=extent, **style)
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set_visible(False)
            if row == 0:
                axes.set_title(f"z = {z / 1000:g} µm", loc="center")
        grid[row, 0].set_ylabel(SCHEMES[scheme].title)
        bar = figure.colorbar(shown, ax=grid[row, :], shrink=0.85, pad=0.01, aspect=14)
        bar.ax.ticklabel_format(axis="y", scilimits=(-2, 3))
        bar.outline.set_visible(False)
    grid[-1, 0].plot([-half + 0.3, -half + 1.3], [-half + 0.35] * 2, color="white", lw=2.5)
    words: Style = {"color": "white", "ha": "center", "fontsize": 8}
    grid[-1, 0].text(-half + 0.8, -half + 0.5, "1 µm", va="bottom", path_effects=HALO, **words)
    return figure


def table_figure(table: pd.DataFrame) -> Figure:
    """Draw Table 1."""
    figure, axes = one_panel(7.4, 3.0)
    rows = table[table["unit"] == "nm"]
    colors = (GREY, GREY, INK, BLUE, VERMILLION)
    for number, (key, mark, color) in enumerate(zip(WAYS, "sx+oD", colors, strict=True)):
        at = np.arange(len(rows)) + 0.13 * (number - 2)
        axes.plot(rows[key], at, mark, color=color, label=WAYS[key], ms=6, mew=1.4)
    for y, (printed, exact) in enumerate(zip(rows["printed"], rows["exact"], strict=True)):
        words = f"printed {printed:g}\nexact {exact:.1f}"
        beside: Style = {"va": "center", "transform": axes.get_yaxis_transform()}
        axes.text(1.02, y, words, fontsize=8, **beside)
    axes.set_yticks(range(len(rows)), [QUANTITY_LABELS[q].split(" [")[0] for q in rows["quantity"]])
    axes.invert_yaxis()
    axes.set_xlim(15, 150)
    plain_log(axes, "x")
    axes.set_xlabel("quantum bound of one collected photon [nm]")
    axes.grid(axis="x", color=GRID, lw=0.8)
    axes.set_axisbelow(True)
    legend(figure, where="lower center", columns=3)
    return figure
