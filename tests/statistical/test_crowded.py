"""Movies with many particles at a time, seen through a microscope that is not ours."""

from __future__ import annotations

import math

import numpy as np
from instruments import PEAK_PER_KDA, Instrument, InstrumentMovie, draw_landings

import iscat_analysis as ia

SIGMAS = 4.0


def test_many_particles_at_a_time_are_not_taken_for_noise() -> None:
    """One to every square micrometre and 700 frames: their rings are more than the noise."""
    shape, pixel_nm = (400, 128, 128), 50.0
    landings = draw_landings(shape, 60, seed=3)
    microscope = Instrument(wavelength_nm=445.0, na=1.49, focus_nm=-250.0, emission="reciprocal")
    movie = InstrumentMovie(microscope, shape, landings, seed=3, pixel_nm=pixel_nm)
    result = ia.fit_movie(
        movie.counts,
        settings={
            "camera.pixel_size_nm": pixel_nm,
            "camera.gain_e_per_adu": 4.0,
            "optics.wavelength_nm": 445.0,
            "optics.na": 1.49,
            "optics.focus_nm": -250.0,
            "optics.calibrate": "never",
            "background.method": "sliding",
            "calibration.gradient_per_kda": -PEAK_PER_KDA,
        },
    )
    assert result.summary["landing"]["noise_variance_over_shot"][-1] > 1.4
    found = result.table
    apart = np.hypot(
        found["x_px"].to_numpy()[:, None] - landings.x_px,
        found["y_px"].to_numpy()[:, None] - landings.y_px,
    )
    near = (apart < 3) & (np.abs(found["frame"].to_numpy()[:, None] - landings.frame) < 12)
    assert near.any(axis=0).sum() >= 57
    assert near.any(axis=1).all()
    ok = (found["status"] == "ok").to_numpy() & (near.sum(axis=1) == 1)
    truth = landings.mass_kda[near.argmax(axis=1)]
    pulls = ((found["mass_kda"] - truth) / found["sigma_mass_kda"])[ok]
    assert ok.sum() >= 45
    assert abs(pulls.mean()) < SIGMAS / math.sqrt(ok.sum())
    assert abs(pulls.std() - 1) < SIGMAS / math.sqrt(2 * ok.sum())
