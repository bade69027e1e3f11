"""Calibrations from files to a folder: camera from its noise, optics from particles, mass."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import pandas as pd

from iscat_analysis import calibration
from iscat_analysis.answers.output import Writing, folder_for, tell
from iscat_analysis.calibration import made_with, measured_contrasts
from iscat_analysis.camera import CameraCalibration, measure_camera
from iscat_analysis.config import Config
from iscat_analysis.findings.tables import NO_RECORDED_OPTICS
from iscat_analysis.instrument.learning import calibrate_movie
from iscat_analysis.instrument.result import OpticsCalibration
from iscat_analysis.instrument.template import MeasuredPicture, measure_template
from iscat_analysis.movie import ArrayLike, open_stack
from iscat_analysis.movie.tables import read_events
from iscat_analysis.optics.waves import sha256_of
from iscat_analysis.records import FloatArray
from iscat_analysis.report.calibration import camera_page, mass_page, optics_page, template_page
from iscat_analysis.schemas import jsonable

_MAPS = ("gain_e_per_adu.tif", "offset_adu.tif", "read_noise_e.tif", "masked.tif")
_BINS = 120


def camera_calibration(
    stacks: Sequence[Path],
    out: Path,
    *,
    dark: Path | None = None,
    offset_adu: float | None = None,
    maps: bool = False,
    **writing: Unpack[Writing],
) -> CameraCalibration:
    """Calibrate a camera from recordings and write what was found."""
    names = ("camera.json", "camera.toml", "camera.html", *_MAPS)
    folder = folder_for(out, *names, **writing)
    with ExitStack() as opened:
        light = [opened.enter_context(open_stack(path)) for path in stacks]
        shade = opened.enter_context(open_stack(dark)) if dark is not None else None
        found = measure_camera(
            light, dark=shade, offset_adu=offset_adu, maps=maps, progress=folder.progress
        )
    tell(found.notes, folder.notify)
    paths = [*stacks, *([dark] if dark else [])]
    contents = {"recordings": [str(p) for p in stacks], "dark": str(dark) if dark else None}
    contents |= found.to_dict()
    toml = found.to_toml({key: f"{key}.tif" for key in found.maps})
    files: dict[str, Any] = {
        "camera.json": ("camera", contents),
        "camera.toml": toml,
        **{f"{key}.tif": values.astype(np.float32) for key, values in found.maps.items()},
        "camera.html": camera_page(", ".join(p.name for p in paths), jsonable(contents), toml),
    }
    if maps:
        masked = np.logical_or.reduce(list(found.masked.values()))
        files["masked.tif"] = masked.astype(np.uint8)
    folder.write(files)
    return found


def optics_calibration(
    movie: str | Path | ArrayLike,
    config: Config,
    out: Path,
    *,
    name: str | None = None,
    free: str | Sequence[str] | None = None,
    focus_step_nm: float | None = None,
    **writing: Unpack[Writing],
) -> OpticsCalibration:
    """Learn the optics from a movie and write what was found.

    Shapes: `movie` (t, y, x).
    """
    names = ("optics.json", "optics.toml", "optics.html")
    folder = folder_for(out, *names, **writing)
    with open_stack(movie, name=name) as stack:
        title = stack.path.name
        found = calibrate_movie(
            stack,
            config,
            free=free,
            focus_step_nm=focus_step_nm,
            progress=folder.progress,
            notify=folder.notify,
        )
    tell([note.text for note in found.notes], folder.notify)
    contents, toml = found.to_dict(), found.to_toml()
    files = {
        "optics.json": ("optics", contents),
        "optics.toml": toml if found.accepted else None,
        "optics.html": optics_page(title, jsonable(contents), toml),
    }
    folder.write(files)
    return found


def template_calibration(
    movie: Path, config: Config, out: Path, **writing: Unpack[Writing]
) -> MeasuredPicture:
    """Measure the picture of a particle in a movie and write what was found."""
    names = ("template.json", "template.npz", "template.html", "optics.toml")
    folder = folder_for(out, *names, **writing)
    with open_stack(movie) as stack:
        found = measure_template(stack, config, progress=folder.progress, notify=folder.notify)
    content, contents = found.template.to_bytes(), found.to_dict()
    toml = found.to_toml("template.npz", sha256_of(content))
    files = {
        "template.json": ("template", contents),
        "template.npz": content if found.accepted else None,
        "optics.toml": toml if found.accepted else None,
        "template.html": template_page(movie.name, jsonable(contents), found.template, toml),
    }
    folder.write(files)
    return found


def mass_calibration(
    events: Path,
    standards_kda: Sequence[float],
    out: Path,
    *,
    standards_se_kda: Sequence[float] | None = None,
    peaks_at: Sequence[float] | None = None,
    landing: calibration.Landing | None = None,
    standards: Config | None = None,
    **writing: Unpack[Writing],
) -> calibration.MassCalibration:
    """Calibrate contrast against standards and write what was found.

    The configuration of their analysis, which says with what optics they were measured, is that
    beside ``fits.csv`` where none is given.
    """
    names = ("calibration.json", "calibration.toml", "calibration.html")
    folder = folder_for(out, *names, **writing)
    table = read_contrasts(events)
    contrast = table["contrast"].to_numpy(float)
    if landing is None:
        landing = _landing(contrast, table["mass_kda"].to_numpy(float))
    sigma = table["sigma_contrast"].to_numpy(float) if "sigma_contrast" in table else None
    found = calibration.calibrate_mass(
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
        unknown = NO_RECORDED_OPTICS(where=str(events))
        found = replace(found, findings=(*found.findings, unknown))
    else:
        found = replace(found, recorded=calibration.standards_of(standards))
    tell(found.notes, folder.notify)
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
    files = {
        "calibration.json": ("calibration", contents),
        "calibration.toml": toml,
        "calibration.html": mass_page(events.name, jsonable(contents), toml),
    }
    folder.write(files)
    return found


def contrast_peaks(events: Path) -> tuple[FloatArray, list[calibration.ContrastPeak]]:
    """Give the |contrast| of the landings in a table, and the peaks that it has.

    Shapes: result (n,).
    """
    table = read_contrasts(events)
    contrast = table["contrast"].to_numpy(float)
    sign = 1 if _landing(contrast, table["mass_kda"].to_numpy(float)) == "bright" else -1
    size = sign * contrast
    sigma = np.zeros(size.shape)
    if "sigma_contrast" in table:
        sigma = table["sigma_contrast"].to_numpy(float)
    known = (size > 0) & np.isfinite(size) & np.isfinite(sigma)
    if np.count_nonzero(known) < calibration.LEAST_EVENTS:
        return size[known], []
    return size[known], calibration.find_contrast_peaks(size[known], sigma[known])


def read_contrasts(path: Path) -> pd.DataFrame:
    """Read contrasts and masses from any table of events."""
    return measured_contrasts(read_events(path), path)


def _landing(contrast: np.ndarray[Any, Any], mass: np.ndarray[Any, Any]) -> calibration.Landing:
    """Find the sign of landing from the masses of a table; dark where there are none."""
    product = contrast * mass
    product = product[np.isfinite(product)]
    return "bright" if product.size and float(np.median(product)) > 0 else "dark"
