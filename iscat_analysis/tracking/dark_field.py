"""Mode ``track`` in dark field: particles that move add their light to that of the background.

The background of a pixel that is most likely, given the particles, is the mean of what the frames
have beside these.  It is found in turns, as over an interferometric background: the median of the
frames, the particles over it, the light beside the particles, and so on until that stands still.
An image is that of the path during the exposure, with the median D of the tracks.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pandas as pd

from iscat_analysis.config import Config
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.fitting.events import Region, photons_scale
from iscat_analysis.fitting.field import add_signal
from iscat_analysis.fitting.results import DetectionResult
from iscat_analysis.optics.model import PATH_SPREAD, blurred, path_variance_nm2
from iscat_analysis.records import FloatArray, Windows, is_event
from iscat_analysis.species.diffusion import estimate_diffusion
from iscat_analysis.species.tracks import rows_by_track
from iscat_analysis.tracking.moving_field import exposure_of
from iscat_analysis.tracking.moving_table import loss_to_blur

_MOST_TURNS = 12
_SETTLED = 0.3  # change of the background, in σ of the mass of a track that has all of it
_LARGEST_FACTOR = 0.8  # of a step to the one before, with which the end is extrapolated


Track = Callable[[AnalysisContext, Windows], DetectionResult]
"""Fits every frame over a background, and links the fits."""


def in_turns(
    config: Config, context: AnalysisContext, windows: Windows, track: Track
) -> DetectionResult:
    """Track particles over a background that is learnt with them, from the median of all frames."""
    sharp, variance_nm2 = context, 0.0
    upwards = config.track.free == "joint"
    last: FloatArray | None = None
    for turn in range(_MOST_TURNS):
        found = track(context, windows)
        if found.interrupted:
            break
        ground = beside_particles(context, windows, found.fits)
        error = np.sqrt(np.maximum(ground + windows.read_variance_before_e2, 1.0))
        step = np.where(windows.masked, 0.0, (ground - windows.before_e) / error)
        if turn > 1 and math.sqrt(np.sum(step**2)) < _SETTLED:
            break
        if last is not None:  # turns come nearer by one factor each, as slowly as particles move
            factor = np.sum(step * last) / np.sum(last**2)
            step = step / (1 - min(max(factor, 0.0), _LARGEST_FACTOR))
        last = step if turn else None
        windows = replace(windows, before_e=np.maximum(windows.before_e + step * error, 0.0))
        variance_nm2 = _path_variance_nm2(config, found.fits)
        near, far = (
            blurred(model, variance_nm2, upwards=upwards) for model in (sharp.model, sharp.wide)
        )
        context = replace(sharp, model=near, wide=far)
    fits = found.fits
    path = PATH_SPREAD * loss_to_blur(sharp, variance_nm2, upwards=upwards) * fits["mass_kda"].abs()
    errors = ("sigma_mass_kda", "crb_mass_kda")
    wider = {name: np.hypot(fits[name], path) for name in errors}
    return replace(
        found,
        context=replace(sharp, mode="track", config=config),
        fits=fits.assign(**wider),
        repeats=(),
        empty=None,
    )


def beside_particles(context: AnalysisContext, windows: Windows, fits: pd.DataFrame) -> FloatArray:
    """Give the light of all frames without that of the particles, for as many frames as before.

    Shapes: result (y, x) [e].
    """
    rows, columns = windows.after_e.shape
    field, signal = Region((0, rows), (0, columns)), np.zeros(windows.after_e.shape)
    known = is_event(fits) & fits["mass_kda"].notna() & fits["x_nm"].notna()
    for place in fits.loc[known, ["x_nm", "y_nm", "z_nm", "mass_kda"]].to_numpy(float).tolist():
        add_signal(context, tuple(place), field, signal)
    one = replace(windows, power_ratio=1 / windows.n_before)  # a frame of the usual light
    light = windows.after_e - photons_scale(context, one) * signal
    return np.asarray(np.maximum(light * windows.n_before / windows.n_after, 0.0))


def _path_variance_nm2(config: Config, fits: pd.DataFrame) -> float:
    """Median variance of the paths of long tracks about their means, in an exposure."""
    rate, exposure_s = exposure_of(config)
    if config.camera.frame_rate_hz is None:
        return 0.0
    found = []
    for rows in rows_by_track(fits).values():
        placed = rows.placed()
        if len(placed.frame) >= config.track.min_frames:
            d, _ = estimate_diffusion(
                *placed.positions(), frame_rate_hz=rate, exposure_ms=1e3 * exposure_s
            )
            found += [d] * len(placed.frame)
    return path_variance_nm2(max(float(np.median(found)), 0.0), exposure_s) if found else 0.0
