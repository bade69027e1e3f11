"""What is summed must be the same throughout: particles that change, frames that repeat."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile
from scenes import PIXEL_NM, make_config

from iscat_analysis.movie import open_stack
from iscat_analysis.optics.forward import PixelGrid, forward_model
from iscat_analysis.pipeline import analyse
from iscat_analysis.records import Analysis

FRAMES, SHAPE, LEVEL_E, MASS = 30, (64, 64), 4e5, 500.0
PLACES = ((1500.0, 1700.0), (3900.0, 3600.0))  # the first may land late


def _analysed(
    folder: Path, *, late: int = 0, stuck: tuple[int, ...] = (), sigma: str = "curvature"
) -> Analysis:
    config = make_config(
        background={"frames": [0, FRAMES]},
        fit={"frames": [FRAMES, 2 * FRAMES], "roi_nm": 2200.0, "sigma": sigma},
        camera={"well_depth_e": 1e9},
    )
    grid = PixelGrid.region((0, SHAPE[0]), (0, SHAPE[1]), PIXEL_NM)
    model, rng = forward_model(config, grid.diagonal_nm), np.random.default_rng(6)
    pictures = [model.image(grid, *place, 5.0, MASS) for place in PLACES]
    counts = np.empty((2 * FRAMES, *SHAPE), dtype=np.uint32)
    for frame in range(2 * FRAMES):
        landed = (frame >= FRAMES + late, frame >= FRAMES)
        signal = sum(p * there for p, there in zip(pictures, landed, strict=True))
        counts[frame] = rng.poisson(LEVEL_E * (1 + signal))
        if frame in stuck:
            counts[frame] = counts[frame - 1]
    tifffile.imwrite(folder / "movie.tif", counts, photometric="minisblack")
    with open_stack(folder / "movie.tif") as movie:
        return analyse(movie, config)


def test_a_particle_that_lands_late_is_not_ok(tmp_path: Path) -> None:
    found = _analysed(tmp_path, late=FRAMES // 2)
    table = found.table.sort_values("x_nm")
    assert table["mass_kda"].iloc[0] == pytest.approx(MASS / 2, rel=0.1)
    assert table["status"].tolist() == ["poor_fit", "ok"]
    said = [text for text in found.summary["warnings"] if "changes within the frames" in text]
    assert len(said) == 1
    assert said[0].startswith("the mass of 1 event changes")


def test_errors_that_were_measured_hold_the_change(tmp_path: Path) -> None:
    found = _analysed(tmp_path, late=FRAMES // 2, sigma="measured")
    assert not any("changes within the frames" in text for text in found.summary["warnings"])


def test_frames_that_repeat_are_told_and_no_gain_is_blamed(tmp_path: Path) -> None:
    stuck = (*range(3, FRAMES, 3), FRAMES + 7)
    said = "\n".join(_analysed(tmp_path, stuck=stuck).summary["warnings"])
    assert "movie.tif: frames 3, 6, 9, 12 and 6 more of 60 repeat the frame before" in said
    assert "gain" not in said
    assert "the configured optics do not describe" not in said


def test_a_good_movie_is_told_nothing_of_it(tmp_path: Path) -> None:
    found = _analysed(tmp_path)
    assert (found.table["status"] == "ok").all()
    told = "\n".join(found.summary["warnings"])
    assert "repeat" not in told
    assert "changes" not in told
