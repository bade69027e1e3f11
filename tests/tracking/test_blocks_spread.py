"""A stage that drifts: masses of tracks over one background, and over those of blocks of frames."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from wanderers import SETTINGS, Wanderers, wander

import iscat_analysis as ia

pytestmark = pytest.mark.large

DRIFT_NM = 0.03  # a frame, 10 nm/s: 6 nm in all
SPECIES = ((400.0, 0.15, 2), (200.0, 0.8, 1))
NEAR_NM = 300.0


def _pulls(movie: Wanderers, frames: int | str) -> tuple[list[float], int, int]:
    """Give (mass − truth)/σ of every track that is a particle, the blocks, and rows of nothing."""
    found = ia.fit_movie(movie.counts, settings={**SETTINGS, "track.block_frames": frames})
    rows = found.table.merge(
        movie.truth, on="frame", suffixes=("", "_true"), how="inner"
    )  # fmt: skip
    rows["away"] = np.hypot(rows["x_nm"] - rows["x_nm_true"], rows["y_nm"] - rows["y_nm_true"])
    nearest = rows.loc[rows.groupby(["track", "frame"])["away"].idxmin()]
    true = nearest[nearest["away"] < NEAR_NM]
    tracks = found.tracks.set_index("track")
    pulls = []
    for track, mine in true.groupby("track"):
        if len(mine) > tracks.loc[track, "n_frames"] / 2:
            off = tracks.loc[track, "mass_kda"] - mine["mass_kda_true"].median()
            pulls.append(float(off / tracks.loc[track, "sigma_mass_kda"]))
    return pulls, int(found.summary["blocks"]["number"]), len(nearest) - len(true)


def test_blocks_keep_masses_right_where_the_stage_drifts(
    repetitions: Callable[[int, int], int],
) -> None:
    """C is 38 of all 200 frames: one background is wrong by several times what errors say."""
    movies = [
        wander((200, 64, 64), seed=seed, species=SPECIES, drift_nm_per_frame=(DRIFT_NM, 0.0))
        for seed in range(1, 1 + repetitions(4, 12))
    ]
    spread = {}
    for frames in ("auto", 200):
        runs = [_pulls(movie, frames) for movie in movies]
        pulls = np.concatenate([run[0] for run in runs])
        spread[frames] = float(np.sqrt(np.mean(pulls**2)))
        print(
            f"\n{frames}: {runs[0][1]} blocks, {pulls.size} tracks, pulls of the mass "
            f"{pulls.mean():.2f} ± {pulls.std():.2f}, {sum(run[2] for run in runs)} rows of nothing"
        )
        assert (runs[0][1] > 1) == (frames == "auto")
    assert spread["auto"] < 2.0
    assert spread[200] > 1.4 * spread["auto"]
