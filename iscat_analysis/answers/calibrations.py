"""Calibrations from files to a folder: camera from its noise, optics from particles, mass."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import tifffile

from iscat_analysis.calibration import (
    LEAST_EVENTS,
    ContrastPeak,
    Landing,
    MassCalibration,
    calibrate_mass,
    find_contrast_peaks,
    standards_of,
)
from iscat_analysis.calibration.line import made_with, measured_contrasts
from iscat_analysis.camera import CameraCalibration, measure_camera
from iscat_analysis.config import Config
from iscat_analysis.instrument.learning import calibrate_movie
from iscat_analysis.instrument.result import OpticsCalibration
from iscat_analysis.instrument.template import MeasuredPicture, measure_template
from iscat_analysis.movie import ArrayLike, open_stack
from iscat_analysis.movie.event_tables import read_events
from iscat_analysis.optics.measured import sha256_of
from iscat_analysis.records import FloatArray, Progress, silent
from iscat_analysis.report import atomic_folder, check_output
from iscat_analysis.report.calibration import camera_page, mass_page, optics_page, template_page
from iscat_analysis.schemas import jsonable, to_json

CAMERA_FILES = frozenset(
    {
        "camera.json",
        "camera.toml",
        "camera.html",
        "gain_e_per_adu.tif",
        "offset_adu.tif",
        "read_noise_e.tif",
        "masked.tif",
    }
)
"""Everything a camera calibration may leave in its folder."""

MASS_FILES = frozenset({"calibration.json", "calibration.toml", "calibration.html"})
"""Everything a mass calibration may leave in its folder."""

OPTICS_FILES = frozenset({"optics.json", "optics.toml", "optics.html"})
"""Everything a calibration of the optics may leave in its folder."""

TEMPLATE_FILES = frozenset({"template.json", "template.npz", "template.html", "optics.toml"})
"""Everything a measured picture may leave in its folder."""

_BINS = 120

_NO_RECORD = (
    "does not say with what optics the standards were measured, so that [calibration] has no "
    "record of them and is taken at those that are configured where it is used; give the folder "
    "of an analysis, with its config.toml"
)


def camera_calibration(
    stacks: Sequence[Path],
    out: Path,
    *,
    dark: Path | None = None,
    offset_adu: float | None = None,
    maps: bool = False,
    overwrite: bool = False,
    progress: Progress = silent,
    notify: Callable[[str], None] | None = None,
) -> CameraCalibration:
    """Calibrate a camera from recordings and write what was found."""
    check_output(out, overwrite, known=CAMERA_FILES)
    with ExitStack() as opened:
        light = [opened.enter_context(open_stack(path)) for path in stacks]
        shade = opened.enter_context(open_stack(dark)) if dark is not None else None
        found = measure_camera(
            light, dark=shade, offset_adu=offset_adu, maps=maps, progress=progress
        )
    for note in found.notes:
        if notify is not None:
            notify(note)
    names = {key: f"{key}.tif" for key in found.maps}
    title = ", ".join(path.name for path in (*stacks, *([dark] if dark else [])))
    contents = {"recordings": [str(p) for p in stacks], "dark": str(dark) if dark else None}
    contents |= found.to_dict()
    toml = found.to_toml(names)
    with atomic_folder(out, overwrite, known=CAMERA_FILES) as folder:
        (folder / "camera.json").write_text(to_json("camera", contents) + "\n", encoding="utf-8")
        (folder / "camera.toml").write_text(toml, encoding="utf-8")
        for key, values in found.maps.items():
            tifffile.imwrite(folder / names[key], values.astype(np.float32))
        if maps:
            masked = np.logical_or.reduce(list(found.masked.values()))
            tifffile.imwrite(folder / "masked.tif", masked.astype(np.uint8))
        page = camera_page(title, jsonable(contents), toml)
        (folder / "camera.html").write_text(page, encoding="utf-8")
    return found


def optics_calibration(
    movie: str | Path | ArrayLike,
    config: Config,
    out: Path,
    *,
    name: str | None = None,
    free: str | Sequence[str] | None = None,
    focus_step_nm: float | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
    notify: Callable[[str], None] | None = None,
) -> OpticsCalibration:
    """Learn the optics from a movie and write what was found.

    Shapes: `movie` (t, y, x).
    """
    check_output(out, overwrite, known=OPTICS_FILES)
    with open_stack(movie, name=name) as stack:
        title = stack.path.name
        found = calibrate_movie(
            stack, config, free=free, focus_step_nm=focus_step_nm, progress=progress, notify=notify
        )
    for note in found.notes:
        if notify is not None:
            notify(note)
    contents = found.to_dict()
    toml = found.to_toml()
    with atomic_folder(out, overwrite, known=OPTICS_FILES) as folder:
        (folder / "optics.json").write_text(to_json("optics", contents) + "\n", encoding="utf-8")
        if found.accepted:
            (folder / "optics.toml").write_text(toml, encoding="utf-8")
        page = optics_page(title, jsonable(contents), toml)
        (folder / "optics.html").write_text(page, encoding="utf-8")
    return found


def template_calibration(
    movie: Path,
    config: Config,
    out: Path,
    *,
    overwrite: bool = False,
    progress: Progress = silent,
    notify: Callable[[str], None] | None = None,
) -> MeasuredPicture:
    """Measure the picture of a particle in a movie and write what was found."""
    check_output(out, overwrite, known=TEMPLATE_FILES)
    with open_stack(movie) as stack:
        found = measure_template(stack, config, progress=progress, notify=notify)
    content = found.template.to_bytes()
    toml = found.to_toml("template.npz", sha256_of(content))
    contents = found.to_dict()
    with atomic_folder(out, overwrite, known=TEMPLATE_FILES) as folder:
        text = to_json("template", contents)
        (folder / "template.json").write_text(text + "\n", encoding="utf-8")
        if found.accepted:
            (folder / "template.npz").write_bytes(content)
            (folder / "optics.toml").write_text(toml, encoding="utf-8")
        page = template_page(movie.name, jsonable(contents), found.template, toml)
        (folder / "template.html").write_text(page, encoding="utf-8")
    return found


def mass_calibration(
    events: Path,
    standards_kda: Sequence[float],
    out: Path,
    *,
    standards_se_kda: Sequence[float] | None = None,
    peaks_at: Sequence[float] | None = None,
    landing: Landing | None = None,
    standards: Config | None = None,
    overwrite: bool = False,
    notify: Callable[[str], None] | None = None,
) -> MassCalibration:
    """Calibrate contrast against standards and write what was found.

    The configuration of their analysis, which says with what optics they were measured, is that
    beside ``fits.csv`` where none is given.
    """
    check_output(out, overwrite, known=MASS_FILES)
    table = read_contrasts(events)
    contrast = table["contrast"].to_numpy(float)
    if landing is None:
        landing = _landing(contrast, table["mass_kda"].to_numpy(float))
    sigma = table["sigma_contrast"].to_numpy(float) if "sigma_contrast" in table else None
    found = calibrate_mass(
        contrast,
        standards_kda,
        standards_se_kda=standards_se_kda,
        peaks_at=peaks_at,
        sigmas=sigma,
        landing=landing,
        name=str(events),
    )
    standards = made_with(table) if standards is None else standards
    if standards is None:
        notes = (*found.notes, f"{events}: {_NO_RECORD}")
        found = replace(found, notes=notes)
    else:
        found = replace(found, recorded=standards_of(standards))
    for note in found.notes:
        if notify is not None:
            notify(note)
    direction = -1.0 if found.landing == "dark" else 1.0
    size = direction * contrast[direction * contrast > 0]
    top = 1.25 * max(peak.contrast for peak in found.peaks)
    counts, edges = np.histogram(size, bins=_BINS, range=(0.0, top))
    contents = {
        "source": str(events),
        **found.to_dict(),
        "histogram": {"edges": edges.tolist(), "counts": counts.tolist()},
    }
    toml = found.to_toml()
    with atomic_folder(out, overwrite, known=MASS_FILES) as folder:
        text = to_json("calibration", contents)
        (folder / "calibration.json").write_text(text + "\n", encoding="utf-8")
        (folder / "calibration.toml").write_text(toml, encoding="utf-8")
        page = mass_page(events.name, jsonable(contents), toml)
        (folder / "calibration.html").write_text(page, encoding="utf-8")
    return found


def contrast_peaks(events: Path) -> tuple[FloatArray, list[ContrastPeak]]:
    """Give the |contrast| of the landings in a table, and the peaks that it has.

    Shapes: result (n,).
    """
    table = read_contrasts(events)
    contrast = table["contrast"].to_numpy(float)
    lands = contrast > 0
    if _landing(contrast, table["mass_kda"].to_numpy(float)) == "dark":
        lands = contrast < 0
    size = np.abs(contrast[lands])
    sigma = np.zeros(size.shape)
    if "sigma_contrast" in table:
        sigma = table["sigma_contrast"].to_numpy(float)[lands]
    known = np.isfinite(size) & np.isfinite(sigma)
    if np.count_nonzero(known) < LEAST_EVENTS:
        return size[known], []
    return size[known], find_contrast_peaks(size[known], sigma[known])


def read_contrasts(path: Path) -> pd.DataFrame:
    """Read contrasts and masses from any table of events."""
    return measured_contrasts(read_events(path), path)


def _landing(contrast: np.ndarray[Any, Any], mass: np.ndarray[Any, Any]) -> Landing:
    """Find the sign of landing from the masses of a table; dark where there are none."""
    product = contrast * mass
    product = product[np.isfinite(product)]
    return "bright" if product.size and float(np.median(product)) > 0 else "dark"
