"""The camera from its own noise: gain, offset and read noise by photon transfer.

A pixel of gain g [e/count], offset o [counts] and read noise σ_r [e] that receives μ photoelectrons
per frame has the mean m = o + μ/g and the variance

    v = (m − o)/g + σ_r²/g²                              (Janesick, *Photon Transfer*, 2007)

so the slope of variance against mean over pixels of different brightness is 1/g.  What follows
from which recording:

* a **dark** gives o and σ_r, pixel by pixel;
* **power that flickers**, or several levels of the same scene, give o: every pixel follows the
  laser by its light alone, dm_p/dρ = μ_p/g = m_p − o, a line whose zero is the offset;
* **neither**: only o − σ_r²/g, where the line meets v = 0, can be known, and is said to be so.

Laser power is taken out by regressing each pixel's frame-to-frame differences on those of the whole
frame, which needs no offset.  Rounding to whole counts is part of the read noise.

`measure` is the whole measurement.  On its way, `moments` reads the stacks, `pixels` says what
to leave out, `regression` makes a camera of the rest, and `averaging` sets its noise beside
shot noise; `result` is what comes out.  `zero` looks at the offset alone, for a movie that is
analysed.
"""

from __future__ import annotations

from iscat_analysis.camera.calibration.averaging import LEAST_EXCESS_VARIANCE
from iscat_analysis.camera.calibration.measure import (
    LEAST_FRAMES,
    LEAST_FRAMES_FOR_MAPS,
    measure_camera,
)
from iscat_analysis.camera.calibration.result import CameraCalibration, Estimate
from iscat_analysis.camera.calibration.zero import LightZero, find_zero

__all__ = [
    "LEAST_EXCESS_VARIANCE",
    "LEAST_FRAMES",
    "LEAST_FRAMES_FOR_MAPS",
    "CameraCalibration",
    "Estimate",
    "LightZero",
    "find_zero",
    "measure_camera",
]
