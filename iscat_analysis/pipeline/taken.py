"""What dividing by the light of lines takes of particles that move, in words."""

from __future__ import annotations

import numpy as np

from iscat_analysis.movie.lines import Lines
from iscat_analysis.pipeline.field import add_signal
from iscat_analysis.pipeline.regions import Region, region_around
from iscat_analysis.pipeline.scene import Scene
from iscat_analysis.records import Candidate

WORTH_SAYING = 0.005
"""Part of a mass below which it is not said."""


def part_taken(scene: Scene, lines: Lines) -> float:
    """Give the part of a particle's mass that is divided out with the light.

    A particle is part of the light of its lines, and of what changes smoothly.  Fits of single
    frames do not know what is divided out with it: their mass is the projection of what is left on
    the picture of a whole particle.

    Parameters
    ----------
    scene : Scene
        From `iscat_analysis.pipeline.moving_field.track_scene`.
    lines : Lines
        What was divided out of the frames.

    Returns
    -------
    float
        Of a particle in the middle of the field.
    """
    rows, columns = lines.light_e.shape
    x_px, y_px = (columns - 1) / 2, (rows - 1) / 2
    z_nm, mass = scene.model.height_nm, scene.model.material.mass_kda
    place = x_px * scene.pixel_nm, y_px * scene.pixel_nm, z_nm, mass
    whole = np.zeros((rows, columns))
    add_signal(scene, place, Region((0, rows), (0, columns)), whole)
    middle = Candidate(x_px, y_px, z_nm, mass, 0.0)
    seen = region_around(scene.roi_px, (rows, columns), middle).slices
    light = lines.light_e[seen]
    left, whole = lines.left(whole)[seen], whole[seen]
    return 1 - float((light * whole * left).sum() / (light * whole**2).sum())


def taken_warning(scene: Scene, lines: Lines | None, name: str) -> str:
    """Say how much too small masses are where lines were divided by their own light.

    Parameters
    ----------
    scene : Scene
        From `iscat_analysis.pipeline.moving_field.track_scene`.
    lines : Lines or None
        What was divided out of the frames.
    name : str
        Of the movie.

    Returns
    -------
    str
        One line; empty where it is less than half a per cent.
    """
    share = 0.0 if lines is None else part_taken(scene, lines)
    if share < WORTH_SAYING:
        return ""
    return (
        f"{name}: a particle is part of the light that each frame was divided by, which makes its "
        f"mass about {100 * share:.2g} % too small, and leaves some of its picture over; record a "
        "wider field, of which it is a smaller part, or light that does not flicker"
    )
