"""The spread of single frames, as tracks have them: where there is no particle, and how it ages."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from report_factory import make_analysis
from scenes import PIXEL_NM, make_config

from iscat_analysis.inference.repeats import LENGTHS, EmpiricalSpread, pooled
from iscat_analysis.movie import open_stack
from iscat_analysis.optics.forward import PixelGrid, forward_model
from iscat_analysis.pipeline import analyse
from iscat_analysis.records import FREE_PARAMETERS
from iscat_analysis.report import render_report
from iscat_analysis.search.empty import EmptyField
from iscat_analysis.trust.checks import likely_noise

SIGMAS = 4.0
LEVEL_E = 1e5
SHAPE = (64, 80)
MASS_KDA = 4000.0
DISTANCES = (20.0, 28.0, 40.0)


def _slopes(half_px: int) -> np.ndarray:
    """Give the derivatives of the signal by the parameters, of unit length."""
    model = forward_model(make_config(optics={"focus_nm": -500.0}), 4000.0)
    grid = PixelGrid.centred(2 * half_px + 1, PIXEL_NM)
    _, first = model.signal(grid, (0.0, 0.0, 150.0, MASS_KDA))
    return np.asarray(first[:4] / np.sqrt((first[:4] ** 2).sum(axis=(1, 2)))[:, None, None])


def _field(shape: tuple[int, int], tile_px: int) -> tuple[EmptyField, np.ndarray]:
    """Give the estimator of an even field, and its light."""
    mean = np.full(shape, LEVEL_E)
    field = EmptyField(
        mean, 0 * mean, np.ones(shape, dtype=bool), _slopes(tile_px), 4,
        additive=False, spacing_px=2, tile_px=tile_px,
    )  # fmt: skip
    return field, mean


# ---- what fits leave ---------------------------------------------------------------------------


def test_a_fit_takes_noise_off_its_neighbourhood() -> None:
    """As much as is computed, between 6 and 12 pixels from it; the control is 1."""
    side, draws, k = 64, 400, 16
    field, mean = _field((side, side), 16)
    slopes = _slopes(k)
    rng = np.random.default_rng(1)
    centre = side // 2
    i, j = (2 * n - centre for n in np.indices((side // 2, side // 2)))
    ring = (np.hypot(i, j) > 6) & (np.hypot(i, j) < 12)
    squares = np.zeros((2, draws, 4))
    for draw in range(draws):
        image = mean + np.sqrt(LEVEL_E) * rng.standard_normal(mean.shape)
        errors = field.errors(image, 1.0, None)
        fit = np.zeros(mean.shape)
        box = slice(centre - k, centre + k + 1)
        fit[box, box] = np.einsum("i,iyx->yx", errors[:, centre // 2, centre // 2], slopes)
        for n, found in enumerate((errors, field.errors(image, 1.0, fit * mean))):
            squares[n, draw] = (found**2 * ring).sum(axis=(1, 2))
    share = squares[1].mean(axis=0) / squares[0].mean(axis=0)
    se = np.std(squares[1] - share * squares[0], axis=0) / np.sqrt(draws) / squares[0].mean(axis=0)
    left = field.left([(centre + 0.2, centre - 0.3)])[:, ring].mean(axis=1)
    assert np.all(np.abs(share - left) < SIGMAS * se)
    assert np.all(np.abs(share - 1) > SIGMAS * se)
    assert np.all(field.left([(-500.0, 2e3)]) == 1)


@pytest.mark.parametrize(("field_px", "tile_px"), [((64, 80), 13), ((96, 96), 16)])
def test_the_interval_knows_what_neighbouring_tiles_have_in_common(field_px, tile_px) -> None:
    """95 % of 100 white fields, ± 2.2 %; tiles taken for independent hold fewer."""
    field, mean = _field(field_px, tile_px)
    rng = np.random.default_rng(5)
    nothing = [field.errors(mean, 1.0, None)]
    held = np.zeros((2, 4))
    for _ in range(100):
        image = mean + np.sqrt(LEVEL_E) * rng.standard_normal(mean.shape)
        found = field.spread(
            nothing, [field.errors(image, 1.0, None)], (np.array([1e12]), np.array([1.0])),
            np.zeros(mean.shape, dtype=bool),
        )  # fmt: skip
        for k in range(4):
            squares, counts = found.squares[[0, 0, 0], k], found.counts[[0, 0, 0]]
            for n, shared in enumerate((float(found.shared[k]), 1.0)):
                one = pooled(_own(1), squares, counts, shared=shared, distances=(1.0,))
                assert one is not None
                held[n, k] += one.ci95[0] < 1 < one.ci95[1]
    assert np.all(np.abs(held[0] / 100 - 0.95) < SIGMAS * 0.022)
    assert held[1].mean() / 100 < 0.92


# ---- pooling -----------------------------------------------------------------------------------


def _own(events: int) -> np.ndarray:
    own = np.zeros((events, 1 + len(LENGTHS), 2))
    own[:, 0, 1] = 50.0
    return own


@pytest.mark.parametrize("variance", [1.0, 1.5])
def test_the_interval_of_single_frames_holds_the_truth_as_often_as_it_says(variance) -> None:
    """Of 400 movies 95 % do, ± 1.1 %."""
    rng = np.random.default_rng(2)
    held = 0
    counts = np.full((2 + len(DISTANCES), 36), 60.0)
    for _ in range(400):
        squares = variance * rng.chisquare(60, counts.shape)
        found = pooled(_own(30), squares, counts, distances=DISTANCES)
        assert found is not None
        held += found.ci95[0] < np.sqrt(variance) < found.ci95[1]
        assert found.single
        assert found.whole
        assert found.events == 30
        assert found.frames == DISTANCES
    assert abs(held / 400 - 0.95) < SIGMAS * 0.011


def test_single_frames_without_empty_places_say_nothing() -> None:
    few = np.full((2 + len(DISTANCES), 3), 60.0)
    assert pooled(_own(30), few, few, distances=DISTANCES) is None
    assert pooled(_own(0), np.ones((5, 36)), np.ones((5, 36)), distances=DISTANCES) is None


# ---- naming ------------------------------------------------------------------------------------


def _single(fast2: float, slow2: np.ndarray) -> EmpiricalSpread:
    """Give what noise does whose slow part has this variance at `DISTANCES`."""
    ratio = float(np.sqrt(fast2 + slow2.mean()))
    return EmpiricalSpread(
        ratio, (ratio - 0.02, ratio + 0.02), 100, True, 30.0,
        DISTANCES, tuple(np.sqrt(fast2 + slow2)), (0.01,) * 3, (np.sqrt(fast2), ratio), True,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("fast2", "slow2", "word"),
    [
        (1.5, np.zeros(3), "gain_e_per_adu"),
        (1.0, 0.5 * np.log(DISTANCES), "flicker"),
        (1.0, (np.array(DISTANCES) / 30) ** 2, "drift"),
    ],
)
def test_the_noise_of_single_frames_is_named(fast2, slow2, word) -> None:
    said = likely_noise(_single(fast2, slow2), {"noise_variance_over_shot": [fast2]})
    assert word in said
    assert ("time since the background" in said) == (word != "gain_e_per_adu")
    assert "drift_correction" not in said
    assert "at the particles" not in said


# ---- a known background ------------------------------------------------------------------------


@pytest.mark.parametrize("pattern", [0.0, LEVEL_E**-0.5])
def test_a_given_background_is_judged_too(pattern: float) -> None:
    """White structure that it does not know, of the size of the noise, doubles the variance."""
    frames = 8
    config = make_config(
        optics={"focus_nm": -500.0}, particle={"height_nm": 150.0, "mass_kda": MASS_KDA},
        background={"frames": None, "method": "known", "level_e": LEVEL_E},
        fit={"mode": "track", "frames": [0, frames], "roi_nm": 2200.0, "z_range_nm": [0.0, 320.0]},
        simulation={"shape": list(SHAPE)}, detection={"false_alarms_per_movie": 1e-9},
    )  # fmt: skip
    grid = PixelGrid.region((0, SHAPE[0]), (0, SHAPE[1]), PIXEL_NM)
    model = forward_model(config, grid.diagonal_nm)
    rng = np.random.default_rng(4)
    light = LEVEL_E * (1 + pattern * rng.standard_normal(SHAPE))
    light = light * (1 + model.image(grid, 2000.0, 2500.0, 150.0, MASS_KDA))
    counts = rng.poisson(light, (frames, *SHAPE)).astype(np.uint32)
    found = analyse(open_stack(counts, name="movie"), config)
    truth = np.sqrt(1 + pattern**2 * LEVEL_E)
    for part in found.summary["precision"].values():
        low, high = part["repeat_over_crb_ci95"]
        assert low < truth < high
        assert high - low < 0.35
        assert part["repeat_frames"][0] == 1
        assert part["empty_over_crb"][0] == pytest.approx(1.0, abs=0.1)
    assert found.summary["repeats"]["understated"] == bool(pattern)


# ---- the report --------------------------------------------------------------------------------


def test_the_page_says_how_the_spread_of_tracks_was_measured() -> None:
    analysis = make_analysis(40, mode="track")
    part = {
        "repeat_over_crb": 1.02, "repeat_over_crb_ci95": [0.97, 1.07], "repeat_significance": 0.8,
        "repeat_events": 40, "repeat_whole": True, "repeat_frames": list(DISTANCES),
        "repeat_over_crb_by_frames": [1.0, 1.01, 1.05],
        "repeat_over_crb_by_frames_se": [0.02] * 3, "empty_over_crb": [1.0, 1.02],
    }  # fmt: skip
    known = analysis.summary.get("precision", {})
    precision = {name: {**known.get(name, {}), **part} for name in FREE_PARAMETERS["track"]}
    analysis = replace(analysis, summary={**analysis.summary, "precision": precision})
    page = render_report(analysis)
    assert "1.02 (0.97 to 1.07)" in page
    assert "Of single frames, where there is no particle" in page
    assert "frames since the background" in page
    assert "parts of the particles' own frames" not in page
