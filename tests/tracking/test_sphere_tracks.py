"""Spheres that move in a volume: their diameters from pictures, their indices from both."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import iscat_analysis as ia

pytestmark = pytest.mark.large

DIAMETER_NM, INDEX = 120.0, 1.46
SETTINGS = {
    "optics": {"wavelength_nm": 525.0, "na": 1.42, "focus_nm": 0.0},
    "camera": {
        "pixel_size_nm": 90.0, "gain_e_per_adu": 1.0, "offset_adu": 0.0, "read_noise_e": 0.0,
        "frame_rate_hz": 1000.0, "exposure_ms": 0.02,
    },
    "particle": {"kind": "silica", "model": "mie", "diameter_nm": DIAMETER_NM},
    "background": {"frames": [0, 100]},
    "fit": {
        "mode": "track", "roi_nm": 2000.0, "z_range_nm": [0.0, 1200.0],
        "diameter_range_nm": [40.0, 250.0],
    },
    "simulation": {
        "shape": [48, 48], "frames": 130, "photons_per_pixel": 5e3,
        "movers": [
            {
                "count": 1, "x_px": 23.0, "y_px": 22.0, "z_nm": 500.0, "diameter_nm": DIAMETER_NM,
                "d_um2_s": 3.6, "space": "volume", "ceiling_nm": 1100.0, "frame": 100,
            }
        ],
    },
}  # fmt: skip


def test_diameters_and_indices_of_tracks(tmp_path: Path, share: float) -> None:
    """With the control that a path which the analysis knows nothing of makes them too small."""
    seeds = range(3, 3 + max(1, round(8 * share)))
    found, sharp = [], []
    for seed in seeds:
        path = tmp_path / f"{seed}.tif"
        ia.simulate_movie(SETTINGS, path, seed=seed)
        result = ia.fit_movie(path, config=SETTINGS)
        assert result.tracks is not None
        found.append(result.tracks)
        assert "systematic_diameter_nm" in result.table
        if seed == seeds[0]:
            blind = ia.fit_movie(path, config=SETTINGS, settings={"camera.exposure_ms": 1e-4})
            assert blind.tracks is not None
            sharp.append(blind.tracks)
    tracks, blind_tracks = pd.concat(found), pd.concat(sharp)
    n = len(tracks)
    assert n == len(seeds)
    for name, truth in (("optical_diameter_nm", DIAMETER_NM), ("refractive_index", INDEX)):
        pulls = (tracks[name] - truth) / tracks[f"sigma_{name}"]
        assert abs(pulls.mean()) < 4 / np.sqrt(n)
        assert n < 4 or pulls.std() < 1 + 4 / np.sqrt(2 * n)
    assert (tracks["optical_probability"] > 0.999).all()
    off = (blind_tracks["optical_diameter_nm"] - DIAMETER_NM) / blind_tracks[
        "sigma_optical_diameter_nm"
    ]
    assert (off < -3).all()
