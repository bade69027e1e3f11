"""What `iscat bounds` writes: one experiment and a scan, the optics, and Dong et al. (2021).

Everything arrives as reports and tables; nothing is computed here but what a figure needs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.bounds import PupilOptimum, plan, tradeoff
from iscat_analysis.config import SCHEMES, config_to_toml
from iscat_analysis.records import PARAMETERS, FloatArray
from iscat_analysis.report.numbers import LABELS, Fact, numeric, of, parameter, tabulate, worded
from iscat_analysis.report.output import atomic_folder
from iscat_analysis.report.page import (
    BLUE,
    GREY,
    LINE,
    VERMILLION,
    Chart,
    Row,
    Section,
    curves,
    interval,
    intervals,
    marks,
    pictures,
    render_document,
    with_ends,
)
from iscat_analysis.report.tables import write_csv, write_json

BOUNDS_FILES = frozenset({"bounds.json", "bounds.html", "scan.csv", "optics.toml"})
"""What `write_bounds` may leave in its folder."""

OPTICS_BOUNDS_FILES = frozenset({"optics_bounds.json", "bounds.html", "needed.csv"})
"""What `write_optics_bounds` leaves in its folder."""

_KINDS = {"crb_joint": "CRB, joint", "crb_single": "CRB, single", "qcrb": "QCRB"}


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
        charts: list[Chart] = []
        if table is not None:
            write_csv(table, building / "scan.csv")
            charts += scan_charts(table, label, here)
        if design is not None:
            (building / "optics.toml").write_text(design_toml(design), encoding="utf-8")
            charts += pupil_charts(design)
        if {"z_nm", "mass_kda"} <= set(report["at"]["free"]):
            charts.append(tradeoff_chart(report))
        _write_page(_bounds_section(report, charts), building)
    return folder


def _write_page(section: Section, folder: Path) -> None:
    at = "of one particle, from its images and from all light that was collected"
    page = render_document("Bounds", f"What can be known {at}", [section])
    (folder / "bounds.html").write_text(page, encoding="utf-8")


def _bounds_section(report: Mapping[str, Any], charts: Sequence[Chart]) -> Section:
    """Lay out the bounds of one experiment."""
    actual, at = report["actual"], report["at"]
    columns = (
        worded("parameter", of("name", parameter)),
        *(numeric(label, of(kind)) for kind, label in _KINDS.items()),
        numeric("Holevo", of("holevo"), "one measurement of all parameters at once"),
    )
    known = {**actual, "holevo": {name: report["holevo"][name] for name in at["free"]}}
    rows = [
        {"name": name, **{kind: known.get(kind, {}).get(name) for kind in (*_KINDS, "holevo")}}
        for name in PARAMETERS
    ]
    photons = report["n_scattered"]
    facts = [
        Fact("Scattered photons", f"{photons['collected']:,.0f}", note="collected"),
        Fact("on the camera", f"{photons['camera']:,.0f}"),
    ]
    table = tabulate(rows, columns, "Standard deviations for these photons")
    lead = f"{SCHEMES[at['scheme']].title}, mode {at['mode']}."
    return Section("bounds", "Bounds", lead, facts, charts, [table])


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


def pupil_charts(design: PupilOptimum) -> Iterator[Chart]:
    """Show what the best pupil gives, and how a particle looks through it."""
    kinds = {"configured": "configured", "best": "best pupil", "holevo": "all at once, at best"}
    rows = [
        interval(LABELS[name], each[kind] / each["qcrb"], series=label)
        for name, each in zip(design.chosen, design.sigma.values(), strict=True)
        for kind, label in kinds.items()
    ]
    yield intervals("best-pupil", rows)
    experiment = plan(design.config)
    x, y, z = (float(v) for v in experiment.theta[:3])
    image = experiment.model.image(experiment.grid, x, y, z, experiment.mass_kda)
    edge, half = float(np.abs(image).max()), float(np.ptp(experiment.grid.x_nm)) / 2e3
    shown = [(with_ends("contrast", -edge, edge), image, (-edge, edge))]
    yield pictures("particle", shown, half)


def tradeoff_chart(report: Mapping[str, Any]) -> Chart:
    """Show how well one measurement can tell height and mass, and how well this microscope does."""
    information = np.asarray(report["qfi"]) + 1j * np.asarray(report["qfi_imaginary"])
    edge = tradeoff(information[2:, 2:])
    actual, both = report["actual"], report["holevo"]
    names = ("z_nm", "mass_kda")
    own = np.array([actual["qcrb"][name] for name in names])
    camera = np.array([actual["crb_joint"][name] for name in names])
    alone, at_best = "quantum bound of each alone", "both at once, at best (Holevo)"
    here, star = "this microscope, joint CRB", "with the best pupil"
    wide = np.nanmax(np.vstack([camera * 1.15, own * 2.2]), axis=0)
    inside = (edge[:, 0] <= wide[0]) & (edge[:, 1] <= wide[1])
    points = [(here, camera)] if np.isfinite(camera).all() else []
    best = report.get("pupil", {}).get("sigma", {})
    if set(names) <= set(best):
        points.append((star, np.array([best[name]["best"] for name in names])))
    equal = [both[name] for name in names]
    parts = [
        marks("line", alone, [own[0]] * 2, [0.8 * own[1], wide[1]], dash="dashed"),
        marks("line", alone, [0.8 * own[0], wide[0]], [own[1]] * 2, dash="dashed"),
        marks("line", at_best, *edge[inside].T),
        marks("point", at_best, equal[:1], equal[1:]),
        *(marks("point", name, at[:1], at[1:]) for name, at in points),
    ]
    span = {"x": [0.8 * own[0], wide[0]], "y": [0.8 * own[1], wide[1]]}
    return curves("tradeoff", parts, {"span": span})


def write_optics_bounds(
    report: Mapping[str, Any], folder: Path, *, overwrite: bool = False
) -> Path:
    """Write how well particles would tell the microscope."""
    with atomic_folder(folder, overwrite, known=OPTICS_BOUNDS_FILES) as building:
        write_json("optics_bounds", report, building / "optics_bounds.json")
        write_csv(pd.DataFrame(report["needed"]), building / "needed.csv")
        lead = f"{report['events']} particles of {report['at']['mass_kda']:g} kDa, all together."
        columns = (
            worded("parameter", "parameter"),
            numeric("value", of("value")),
            numeric("σ", of("sigma")),
            numeric("without images", of("usual_error")),
        )
        table = tabulate(report["parameters"], columns, "Parameters of the optics")
        charts = [needed_chart(report)]
        _write_page(Section("optics", "The optics", lead, charts=charts, tables=[table]), building)
    return folder


def needed_chart(report: Mapping[str, Any]) -> Chart:
    """Show how many particles of which mass the precisions take."""
    needed, goals = pd.DataFrame(report["needed"]), report["goals"]
    lines = {
        "focus_nm": f"focus to {goals['focus_nm']:g} nm",
        "mass_rel": f"masses to {100 * goals['mass_rel']:g} %, in common",
        "identified": "everything identified",
    }
    masses = needed["mass_kda"]
    here = [report["at"]["mass_kda"]], [report["events"]]
    parts = [marks("point", "planned", *here)]
    for column, label in lines.items():
        many = needed[column].astype(float)
        dash = "dotted" if column == "identified" else "solid"
        parts += [marks("line", label, masses, many, dash=dash)]
        parts += [marks("point", label, masses, many)]
    return curves("needed", parts)


def scan_charts(table: pd.DataFrame, label: str, here: float) -> Iterator[Chart]:
    """Show bounds and used information along a scan."""
    x = table.iloc[:, 0].to_numpy(float)
    log = "x" if x.size > 1 and x.min() > 0 and x.max() / x.min() > 50 else ""
    configured = f"configured: {here:g}".replace("-", "−")
    bounds, used = [], []
    for name in PARAMETERS:
        panel = parameter(name)
        for kind, series in _KINDS.items():
            y = table[f"{kind}_{name}"].to_numpy(float)
            if np.isfinite(y).any():
                dash = "dotted" if kind == "crb_single" else "solid"
                bounds.append(marks("line", series, x, y, panel=panel, dash=dash))
        share = 100 * table[f"information_{name}"].to_numpy(float)
        used.append(marks("line", "information used", x, share, panel=panel))
        if x.min() <= here <= x.max():
            for parts in (bounds, used):
                parts.append(marks("rule", configured, [here], panel=panel))
    yield curves("scan", bounds, {"x": label, "log": log})
    yield curves("used", used, {"x": label, "log": log})


# ---- Dong et al. (2021) --------------------------------------------------------------------------

SCHEME_COLORS = {"iscat": BLUE, "cobri": VERMILLION, "darkfield": LINE}


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
    {"comparison.html", "comparison.csv", "table_1.csv", "fig_2a.csv"}
    | {f"fig_{panel}.csv" for panel in PANELS}
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
    "exact, dashed ones the authors'; dotted lines are quantum bounds. How "
    "far the two are apart is shown beside them.",
    "3": "Particle at 5 nm. Mass with everything else known, and for iSCAT with z unknown as well: "
    "in focus the image cannot tell height from mass.",
    "4a": "A weaker reference turns an interferometer into a dark-field microscope. β is the "
    "amplitude of the reference that passes.",
}


def write_paper(
    rows: pd.DataFrame,
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
            write_csv(rows[rows["panel"] == panel], building / f"fig_{panel}.csv")
        for name in ("table_1.csv", "comparison.csv"):
            write_csv(table, building / name)
        drawn = {
            panel: panel_charts(panel, rows[rows["panel"] == panel], quantum) for panel in PANELS
        }
        drawn = {"2a": [images_chart(images, field_nm)], **drawn}
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


def _images_table(images: Mapping[tuple[str, float], FloatArray], field_nm: float) -> pd.DataFrame:
    parts = []
    for (scheme, z), image in images.items():
        axis = (np.arange(image.shape[0]) - (image.shape[0] - 1) / 2) * field_nm / image.shape[0]
        place = pd.DataFrame({"scheme": scheme, "z_nm": z, "y_nm": axis})
        parts.append(place.join(pd.DataFrame(image, columns=[f"x={x:.2f}" for x in axis])))
    return pd.concat(parts, ignore_index=True)


def _sections(table: pd.DataFrame, drawn: Mapping[str, list[Chart]]) -> list[Section]:
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
            charts=[table_chart(table)],
            tables=[tabulate(table.to_dict("records"), columns, "Table 1, five ways")],
            notes=_NOTES,
        )
    ]
    names = {"2a": "figure-2", "3": "figure-3", "4a": "figure-4"}
    titles = {"2a": "Fig. 2a: images", **{p: spec.title for p, spec in PANELS.items()}}
    for panel, title in titles.items():
        title, name = title.replace("Fig. ", "Figure "), names.get(panel, f"panel-{panel}")
        sections.append(Section(name, title, _LEADS.get(panel, ""), charts=drawn[panel]))
    return sections


def curves_of(panel: str, rows: pd.DataFrame, convention: str) -> list[tuple[pd.DataFrame, str]]:
    """Gather the curves of a panel, and what each is called."""
    spec, found = PANELS[panel], []
    rows = rows[(rows["convention"] == convention) & rows["quantity"].isin(spec.quantities)]
    key = "attenuation" if spec.by_attenuation else "scheme"
    if spec.by_attenuation:
        rows = rows.sort_values("attenuation", ascending=False, kind="stable")
    for (first, quantity), group in rows.groupby([key, "quantity"], sort=False):
        joint = str(quantity).endswith("joint")
        if joint and first != "iscat":
            continue  # as in D21; the CSV has all three
        if not spec.by_attenuation:
            name = SCHEMES[first].title
        else:
            name = f"β = {first:g}" if first else "dark field"
        found.append((group, f"{name}, with z unknown" if joint else name))
    return found


def limits_of(
    panel: str, quantum: Mapping[tuple[str, str], FloatArray], convention: str
) -> list[tuple[str, float]]:
    """Gather the quantum bounds of a panel: name and value of each."""
    spec = PANELS[panel]
    if spec.bound is None:
        return []
    if spec.bound != 2:
        return [("quantum bound", float(quantum[convention, "iscat"][spec.bound]))]
    schemes = {"4a": ("cobri",), "4b": ("iscat",)}.get(panel, ("iscat", "cobri"))
    return [
        (f"quantum bound, {SCHEMES[s].title}", float(quantum[convention, s][2])) for s in schemes
    ]


def panel_charts(
    panel: str, rows: pd.DataFrame, quantum: Mapping[tuple[str, str], FloatArray]
) -> list[Chart]:
    """Draw a panel, both conventions over each other, and beside it how far they are apart."""
    spec = PANELS[panel]
    top: list[list[Row]] = []
    apart: list[list[Row]] = []
    both = (curves_of(panel, rows, convention) for convention in ("dong2021", "exact"))
    for (authors, _), (exact, name) in zip(*both, strict=True):
        theirs, ours = (curve["value"].to_numpy(float) for curve in (authors, exact))
        top.append(marks("line", name, exact["x"], ours))
        top.append(marks("line", name, authors["x"], theirs, dash="dashed"))
        ratio = ours / theirs if spec.log else ours - theirs
        apart.append(marks("line", name, exact["x"], ratio))
    ends = [rows["x"].min(), rows["x"].max()]
    for convention in ("exact", "dong2021"):
        for name, value in limits_of(panel, quantum, convention):
            top.append(marks("line", name, ends, [value] * 2, dash="dotted"))
    colours = {SCHEMES[key].title: colour for key, colour in SCHEME_COLORS.items()}
    colours |= {f"quantum bound, {name}": colour for name, colour in colours.items()}
    colours = {} if spec.by_attenuation else {**colours, "quantum bound": GREY}
    between = "exact / authors'" if spec.log else "exact − authors'"
    subject = spec.title.partition(": ")[2].capitalize()
    words = {"span": {"x": ends}, "colours": colours, "x": spec.x_label}
    axes = {"title": subject, "y": spec.y_label, "log": "y" if spec.log else ""}
    of = f"-{panel}"
    return [
        curves("panel", top, {**words, **axes}, of=of),
        curves("apart", apart, {**words, "y": between}, of=of),
    ]


def images_chart(images: Mapping[tuple[str, float], FloatArray], field_nm: float) -> Chart:
    """Show figure 2a: one row per scheme, each with its own grey scale."""
    ends = {
        scheme: (min(float(i.min()) for i in own), max(float(i.max()) for i in own))
        for scheme in dict.fromkeys(scheme for scheme, _ in images)
        for own in [[image for (name, _), image in images.items() if name == scheme]]
    }
    shown = [
        (f"{SCHEMES[scheme].title}, z = {z / 1000:g} µm", image, ends[scheme])
        for (scheme, z), image in images.items()
    ]
    greys = "; ".join(with_ends(SCHEMES[name].title, *both) for name, both in ends.items())
    words = {"columns": len(images) // len(ends), "greys": greys}
    return pictures("images", shown, field_nm / 2000, words)


def table_chart(table: pd.DataFrame) -> Chart:
    """Show Table 1."""
    rows = [
        interval(
            QUANTITY_LABELS[row["quantity"]].split(" [")[0], row[key], series=label, lane=label
        )
        for row in table[table["unit"] == "nm"].to_dict("records")
        for key, label in WAYS.items()
    ]
    return intervals("table-1", rows)
