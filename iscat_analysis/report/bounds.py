"""What `iscat bounds` writes: the bounds of one experiment, and a scan through it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from iscat_analysis.bounds import PupilOptimum, plan, tradeoff
from iscat_analysis.config import config_to_toml
from iscat_analysis.records import PARAMETERS
from iscat_analysis.report.numbers import LABELS, UNITS
from iscat_analysis.report.output import atomic_folder
from iscat_analysis.report.style import BLUE, INK, VERMILLION, log_y, new_figure, publish
from iscat_analysis.schemas import to_json

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
        (building / "bounds.json").write_text(to_json("bounds", report) + "\n", encoding="utf-8")
        if table is not None:
            table.to_csv(
                building / "scan.csv", index=False, float_format="%.9g", lineterminator="\n"
            )
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
    maps = ("gain_e_per_adu", "offset_adu")
    camera = {
        key: str(Path(value).resolve())
        for key in maps
        if isinstance(value := getattr(config.camera.assumed, key), str)
    }
    config = config.model_copy(update={"camera": config.camera.model_copy(update=camera)})
    sections = ("optics", "camera", "particle", "background", "fit", "bounds")
    return (
        "# The pupil with the smallest joint bound of "
        f"{', '.join(design.chosen)}: iscat bounds --optimize pupil.\n"
        f"# It takes {100 * design.share:.1f} % of what one measurement can take of the light.\n"
        "# As --config it gives the same bounds; as optics.file it gives the optics alone, and\n"
        "# bounds.photons_per_pixel must follow the attenuation squared.\n\n"
        + config_to_toml(config, comments=False, sections=sections)
    )


def pupil_figure(design: PupilOptimum) -> Figure:
    """Draw what the best pupil gives, and how a particle looks through it."""
    figure = new_figure(8.4, 3.6)
    left, right = figure.subplots(1, 2, width_ratios=[1.3, 1])
    at = np.arange(len(design.chosen))
    own = np.array([design.sigma_quantum[name] for name in design.chosen])
    for values, marker, color, label in (
        (design.sigma_configured, "D", INK, "configured"),
        (design.sigma, "D", VERMILLION, "best pupil"),
        (design.sigma_holevo, "o", BLUE, "all at once, at best (Holevo)"),
    ):
        left.plot(
            at, np.array([values[name] for name in design.chosen]) / own, marker, color=color,
            label=label,
        )  # fmt: skip
    left.axhline(1.0, color=BLUE, lw=1.2, ls="--", label="quantum bound of each alone")
    left.set_xticks(at, [LABELS[name] for name in design.chosen])
    left.set_xlim(-0.5, at.size - 0.5)
    left.set_ylim(bottom=0.0)
    left.set_ylabel("σ over its own quantum bound")
    experiment = plan(design.config)
    x, y, z = (float(v) for v in experiment.theta[:3])
    grid = experiment.grid
    image = experiment.model.image(grid, x, y, z, experiment.mass_kda)
    edge = float(np.abs(image).max())
    side = np.array([grid.x_nm[0], grid.x_nm[-1]]) / 1e3
    shown = right.imshow(
        image, cmap="RdBu_r", vmin=-edge, vmax=edge, extent=(side[0], side[1], side[1], side[0])
    )
    figure.colorbar(shown, ax=right, label="contrast, best pupil")
    right.set(xlabel="x [µm]", ylabel="y [µm]")
    figure.legend(*left.get_legend_handles_labels(), loc="outside upper left", ncols=4, fontsize=8)
    return figure


def tradeoff_figure(report: Mapping[str, Any]) -> Figure:
    """Draw how well one measurement can tell height and mass, and how well this microscope does."""
    information = np.asarray(report["qfi"]) + 1j * np.asarray(report["qfi_imaginary"])
    edge = tradeoff(information[2:, 2:])
    actual, both = report["actual"], report["holevo"]
    names = ("z_nm", "mass_kda")
    own = np.array([actual["qcrb"][name] for name in names])
    camera = np.array([actual["crb_joint"][name] for name in names])
    figure = new_figure(5.2, 4.2)
    axes = figure.add_subplot()
    axes.axvline(own[0], color=BLUE, lw=1.2, ls="--", label="quantum bound of each alone")
    axes.axhline(own[1], color=BLUE, lw=1.2, ls="--")
    axes.plot(*edge.T, color=BLUE, lw=1.8, label="both at once, at best (Holevo)")
    axes.plot(both["z_nm"], both["mass_kda"], "o", color=BLUE, ms=5, label="with equal weights")
    if np.isfinite(camera).all():
        axes.plot(*camera, "D", color=VERMILLION, ms=6, label="this microscope, joint CRB")
    best = report.get("pupil", {}).get("sigma", {})
    if set(names) <= set(best):
        axes.plot(*(best[name]["best"] for name in names), "*", color=VERMILLION, ms=10,
                  label="with the best pupil")  # fmt: skip
    wide = np.nanmax(np.vstack([camera * 1.15, own * 2.2]), axis=0)
    axes.set(xlim=(0.8 * own[0], wide[0]), ylim=(0.8 * own[1], wide[1]))
    axes.set(xlabel="σ of height [nm]", ylabel="σ of mass [kDa]")
    figure.legend(loc="outside upper left", ncols=2, fontsize=8)
    return figure


def write_optics_bounds(
    report: Mapping[str, Any], folder: Path, *, overwrite: bool = False
) -> Path:
    """Write how well particles would tell the microscope."""
    with atomic_folder(folder, overwrite, known=OPTICS_BOUNDS_FILES) as building:
        (building / "optics_bounds.json").write_text(
            to_json("optics_bounds", report) + "\n", encoding="utf-8"
        )
        needed = pd.DataFrame(report["needed"])
        needed.to_csv(building / "needed.csv", index=False, lineterminator="\n")
        publish(needed_figures(report), building)
    return folder


def needed_figures(report: Mapping[str, Any]) -> Iterator[tuple[str, Figure]]:
    """Draw how many particles of which mass the precisions take."""
    figure = new_figure(6.4, 4.2)
    axes = figure.subplots()
    needed, goals = pd.DataFrame(report["needed"]), report["goals"]
    lines = (
        ("focus_nm", f"focus to {goals['focus_nm']:g} nm", BLUE, "-"),
        ("mass_rel", f"masses to {100 * goals['mass_rel']:g} %, in common", INK, "-"),
        ("identified", "everything identified", INK, ":"),
    )
    for column, label, color, dash in lines:
        axes.plot(
            needed["mass_kda"], needed[column].astype(float), dash, color=color, lw=1.8,
            marker="o", ms=4, label=label,
        )  # fmt: skip
    axes.plot(
        report["at"]["mass_kda"], report["events"], "D", color=VERMILLION, ms=7, label="planned"
    )
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("mass [kDa]")
    axes.set_ylabel("particles needed")
    axes.legend()
    yield "needed", figure


def scan_figures(table: pd.DataFrame, label: str, here: float) -> Iterator[tuple[str, Figure]]:
    """Draw bounds and used information along a scan."""
    figure = new_figure(11, 5.4)
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
        log_y(top)
        top.set_title(f"{LABELS[name]} [{UNITS[name]}]")
        low.plot(x, 100 * table[f"information_{name}"].to_numpy(float), color=BLUE, lw=1.5)
        low.set_ylim(0, 100)
        low.set_xlabel(label)
        if x.min() <= here <= x.max():
            for axes in (top, low):
                axes.axvline(here, color=VERMILLION, lw=1, dashes=(4, 3))
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
    yield "scan", figure
