"""The optics of a movie whose particles all bound at once, and hardly any of them stands alone.

From bright places alone the optics are learned roughly, with what is faint or near another not
accounted for.  With these optics the field is fitted, and from its particles, now all known, the
optics are learned again, until they describe pictures that were not fitted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from scipy.spatial.distance import cdist

from iscat_analysis.calibration.optics import LEAST_SIGHTS, OpticsCalibration, Sight
from iscat_analysis.calibration.optics.settings import with_settings
from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.movie import Stack
from iscat_analysis.movie.camera import Camera
from iscat_analysis.pipeline.field import fit_field
from iscat_analysis.pipeline.microscope import calibrate_sights, with_sign
from iscat_analysis.pipeline.ranges import frame_ranges, measured_windows
from iscat_analysis.pipeline.scene import make_scene
from iscat_analysis.pipeline.sights import APART_NM, bound_sights

LEAST_ROUGH = 6
"""Bright places, whatever is near them, without which the optics are not even learned roughly."""

ROUNDS = 3
"""Of a fit of the field and optics learned from it."""

_APART_NM = (APART_NM, 1600.0, 1300.0, 1000.0, 700.0)


def seen_in_field(
    movie: Stack, config: Config, camera: Camera, pool: ThreadPoolExecutor
) -> tuple[list[Sight], list[Sight]]:
    """Fit the field, and cut out the particles that are farthest from others.

    Parameters
    ----------
    movie : Stack
        With background frames.
    config : Config
        Resolved; with the optics to fit with.
    camera : Camera
        Counts → photoelectrons.
    pool : ThreadPoolExecutor
        Runs the fits.

    Returns
    -------
    sights : list of Sight
        `LEAST_SIGHTS` or more where there are so many, the brightest first.
    others : list of Sight
        Every particle, on small regions.
    """
    fit = config.fit.model_copy(update={"mode": "mass"})
    windows = measured_windows(movie, config, camera, *frame_ranges(movie, config))
    rows, columns = windows.after_e.shape
    scene = make_scene(config.model_copy(update={"fit": fit}), (rows, columns))
    events, _ = fit_field(scene, windows, pool=pool)
    known = np.array([(event.fit.x_nm, event.fit.y_nm) for event in events]).reshape(-1, 2)
    nearest = np.sort(cdist(known, known), axis=1)[:, 1] if len(known) > 1 else np.zeros(0)
    enough = [apart for apart in _APART_NM if (nearest >= apart).sum() >= LEAST_SIGHTS]
    for apart in enough or _APART_NM[-1:]:
        sights, others = bound_sights(movie, config, camera, alone_nm=apart, known_nm=known)
        if len(sights) >= LEAST_SIGHTS:
            break
    return sights, others


def learn_in_field(
    movie: Stack,
    config: Config,
    camera: Camera,
    groups: Sequence[str],
    source: Mapping[str, str],
    pool: ThreadPoolExecutor,
) -> OpticsCalibration:
    """Learn the optics from all particles of a field together.

    Parameters
    ----------
    movie : Stack
        With background frames.
    config : Config
        Resolved; with the optics where the search begins.
    camera : Camera
        Counts → photoelectrons.
    groups : sequence of str
        As for `calibrate_sights`.
    source : mapping of str to str
        As for `calibrate_sights`.
    pool : ThreadPoolExecutor
        Runs the fits.

    Returns
    -------
    OpticsCalibration
        Of the first round that is accepted, or of the last.

    Raises
    ------
    DataError
        The field has too few particles.
    """
    places, others = bound_sights(movie, config, camera, alone_nm=0.0)
    found = calibrate_sights(
        places, others, config, groups, source, least=LEAST_ROUGH, mapper=pool.map
    )
    for _ in range(ROUNDS):
        guess, why = with_sign(with_settings(config, found.measured.settings))
        if guess is None:
            raise DataError(why)
        sights, others = seen_in_field(movie, guess, camera, pool)
        found = calibrate_sights(sights, others, config, groups, source, mapper=pool.map)
        if found.accepted:
            break
    return found
