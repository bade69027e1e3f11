"""Detection: as many false alarms as asked for, no side lobes, signs, sub-pixel starts."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scenes import Light, blank, make_config

from iscat_analysis.config import Config
from iscat_analysis.errors import FloodError
from iscat_analysis.fitting.context import AnalysisContext, make_context
from iscat_analysis.fitting.events import field_likelihood, noise_cumulants, search_likelihood
from iscat_analysis.fitting.field import fit_field
from iscat_analysis.optics.forward import PixelGrid
from iscat_analysis.records import Candidate, Windows
from iscat_analysis.search.templates import (
    MOST_CANDIDATES,
    ExcessNoise,
    find_particles,
    refuse_flood,
    signal_to_noise,
)
from iscat_analysis.study import Movie

FIELD = (96, 96)
TRIALS, SEED = 60, 5
SIGMAS = 4.0  # of a Poisson number

GOLD = {"kind": "gold", "mass_kda": None, "diameter_nm": 30.0}
DARK_FIELD = {
    "calibrated": False,
    "optics": {"scheme": "darkfield", "focus_nm": -400.0},
    "particle": GOLD,
}
JOINT = {"optics": {"focus_nm": -500.0}, "fit": {"mode": "joint", "z_range_nm": [0.0, 500.0]}}


def _windows(level: float, read_noise_e: float, rng: np.random.Generator) -> Windows:
    """Draw a blank field: 30 frames before, 30 after."""
    nothing = np.zeros(FIELD, dtype=bool)
    variance = np.full(FIELD, 30 * read_noise_e**2)
    before, after = (
        rng.poisson(30 * level, FIELD) + np.sqrt(variance) * rng.standard_normal(FIELD)
        for _ in range(2)
    )
    return Windows(
        before_e=before, after_e=after, n_before=30, n_after=30, power_ratio=1.0,
        read_variance_before_e2=variance, read_variance_after_e2=variance,
        masked=nothing, saturated=nothing, frames_before=(0, 30), frames_after=(30, 60),
        power=np.ones(60),
    )  # fmt: skip


def _known(windows: Windows, level: float) -> Windows:
    """Take the background as known."""
    return replace(windows, before_e=np.full(FIELD, level), n_before=0, power_ratio=30.0)


def _alarms(config: Config, level: float, read_noise_e: float, *, lower: float = 1.0) -> int:
    """Count detections in `TRIALS` blank fields, of which one each is allowed."""
    context = make_context(config, FIELD)
    templates = replace(context.templates, threshold=lower * context.templates.threshold)
    rng = np.random.default_rng(SEED)
    alarms = 0
    for _ in range(TRIALS):
        windows = _windows(level, read_noise_e, rng)
        if config.background.method == "known":
            windows = _known(windows, level)
        likelihood = search_likelihood(context, windows, np.zeros(FIELD))
        cumulants = noise_cumulants(context, windows, likelihood)
        alarms += len(
            find_particles(
                likelihood, templates, config.detection, roi_px=context.roi_px, cumulants=cumulants
            )
        )
    return alarms


def _assert_as_asked(alarms: int) -> None:
    """No more than asked for; and no fewer than half, which would cost faint particles."""
    assert alarms < TRIALS + SIGMAS * math.sqrt(TRIALS)
    assert alarms > 0.5 * TRIALS - SIGMAS * math.sqrt(0.5 * TRIALS)


ONE = {"false_alarms_per_movie": 1.0}


@pytest.mark.parametrize(
    ("sections", "level", "read_noise_e"),
    [
        ({}, 1e4, 0.0),
        ({"detection": {"polarity": "dark"}}, 1e4, 0.0),
        ({}, 1e4, 80.0),
        ({"background": {"method": "known", "level_e": 1e4}}, 1e4, 0.0),
        (JOINT, 1e4, 0.0),
        (DARK_FIELD, 1e4, 0.0),
        (DARK_FIELD, 2.0, 0.0),
        (DARK_FIELD, 0.05, 0.0),
        (DARK_FIELD | {"background": {"method": "known", "level_e": 0.05}}, 0.05, 0.0),
        (DARK_FIELD, 0.0, 2.0),
    ],
)
def test_false_alarms_are_as_many_as_asked(
    sections: dict[str, Any], level: float, read_noise_e: float
) -> None:
    """60 blank fields, seed 5, one false alarm allowed in each."""
    detection = ONE | sections.get("detection", {})
    config = make_config(**(sections | {"detection": detection}))
    _assert_as_asked(_alarms(config, level, read_noise_e))


def test_a_threshold_too_low_is_noticed() -> None:
    """Control: 10 % off the threshold, and the test above fails."""
    with pytest.raises(AssertionError):
        _assert_as_asked(_alarms(make_config(detection=ONE), 1e4, 0.0, lower=0.9))


def test_the_threshold_falls_with_the_alarms_allowed() -> None:
    heights = [
        make_context(
            make_config(detection={"false_alarms_per_movie": n}), FIELD
        ).templates.threshold
        for n in (0.01, 0.1, 1.0, 10.0)
    ]
    assert heights == sorted(heights, reverse=True)
    assert 4 < heights[1] < 5


def test_places_that_noise_makes_end_a_search_and_others_do_not() -> None:
    """However many they are: particles and their rings pass the threshold as well."""
    templates = make_context(make_config(), (256, 256)).templates
    wild, mild = ExcessNoise(8.0, "wild"), ExcessNoise(1.5, "mild")
    many = 2 * MOST_CANDIDATES
    with pytest.raises(FloodError, match=f"^{many} places in frames 0:9 pass .*: wild$"):
        refuse_flood(many, templates, wild, images=20, frames=" in frames 0:9")
    refuse_flood(many, templates, mild, images=20)
    refuse_flood(many, templates, None, images=20)
    refuse_flood(MOST_CANDIDATES, templates, wild, images=20)


def test_noise_passes_the_threshold_as_often_as_predicted() -> None:
    """A threshold lower by a factor is to noise what more noise is to the threshold."""
    config, ratio = make_config(), 1.5
    predicted = TRIALS * make_context(config, FIELD).templates.reached_by(ratio)
    found = _alarms(config, 4e5, 0.0, lower=1 / math.sqrt(ratio))
    assert abs(found - predicted) < SIGMAS * math.sqrt(predicted)


def test_the_ratio_is_of_unit_variance_on_noise() -> None:
    """A signal-to-noise ratio deserves its name at every height, read noise included."""
    for sections in ({}, JOINT):
        config = make_config(**sections)
        context = make_context(config, FIELD)
        rng = np.random.default_rng(3)
        maps = [
            signal_to_noise(field_likelihood(context, _windows(1e4, 60.0, rng)), context.templates)[
                0
            ]
            for _ in range(12)
        ]
        inner = np.array(maps)[:, :, 16:-16, 16:-16]
        # some 400 independent patches in each of 12 fields
        assert abs(inner.std() - 1) < SIGMAS / math.sqrt(2 * 12 * 100)
        assert abs(inner.mean()) < SIGMAS / math.sqrt(12 * 50)


# ---- particles -------------------------------------------------------------------------------


def _found(
    config: Config, seed: int, *, explained: bool = False
) -> tuple[AnalysisContext, Movie, tuple[Candidate, ...]]:
    movie = Movie(config, seed=seed)
    context = make_context(config, config.simulation.shape)
    windows = Light.of(movie, 200).draw(np.random.default_rng(seed))
    signal = None
    if explained:
        grid = PixelGrid.region(*((0, n) for n in config.simulation.shape), context.pixel_nm)
        signal = sum(
            context.wide.image(grid, p.x_px * 84.4, p.y_px * 84.4, p.z_nm, p.mass_kda)
            for p in movie.particles
        )
    found = find_particles(
        field_likelihood(context, windows),
        context.templates,
        config.detection,
        roi_px=context.roi_px,
        explained=signal,
    )
    return context, movie, found


def _event(**event: Any) -> dict[str, Any]:
    return {"frame": 200, "x_px": 40.3, "y_px": 31.8} | event


def _at(events: list[dict[str, Any]], **sections: Any) -> Config:
    simulation = {"shape": [72, 80], "frames": 400, "events": events}
    return make_config(**sections, simulation=simulation)


def _fitted(config: Config, seed: int) -> list[Candidate]:
    """Search and fit in turns, as the job does."""
    context = make_context(config, config.simulation.shape)
    windows = Light.of(Movie(config, seed=seed), 200).draw(np.random.default_rng(seed))
    with ThreadPoolExecutor(1) as pool:
        return [e.candidate for e in fit_field(context, windows, pool=pool)[0]]


@pytest.mark.parametrize("mass_kda", [300.0, 3000.0, 10000.0])
def test_side_lobes_are_never_reported(mass_kda: float) -> None:
    """Signal-to-noise ratios up to 800, rings over the whole field; noise is not asked here."""
    config = _at([_event(mass_kda=mass_kda)], detection={"false_alarms_per_movie": 1e-3})
    for seed in range(3):
        (one,) = _fitted(config, seed)
        assert one.mass_kda == pytest.approx(mass_kda, rel=0.2)


PLACES = [
    (16.8, 17.3), (41.2, 16.3), (68.6, 16.9), (15.8, 44.9), (44.1, 44.4), (71.8, 41.1),
    (17.6, 69.6), (43.1, 71.8), (69.3, 71.6),
]  # fmt: skip


@pytest.mark.parametrize("seed", range(4))
def test_one_particle_is_not_shared_by_two_fits(seed: int) -> None:
    """Beside each other both are significant; they part slowly, and one alone is not."""
    rng = np.random.default_rng(seed)
    events = [
        _event(x_px=x, y_px=y, mass_kda=float(rng.choice([200.0, 200.0, 480.0]))) for x, y in PLACES
    ]
    events[5]["mass_kda"] = 480.0
    config = make_config(
        particle={"mass_kda": 146.0},
        camera={"pixel_size_nm": 84.0, "gain_e_per_adu": 4.0},
        detection={"false_alarms_per_movie": 1e-3},
        simulation={"shape": [88, 88], "events": events, "photons_per_pixel": 3e4},
    )
    found = _fitted(config, seed)
    assert len(found) == len(events)
    assert min(abs(one.snr) for one in found) > 20


@pytest.mark.parametrize("z_nm", [20.0, 140.0, 310.0])
def test_side_lobes_are_never_reported_where_the_height_is_free(z_nm: float) -> None:
    """The search starts in the right fringe, and the fit ends at the height."""
    config = _at([_event(mass_kda=3000.0, z_nm=z_nm)], **JOINT)
    assert _found(config, 1)[2][0].z_nm == pytest.approx(z_nm, abs=20)
    (one,) = _fitted(config, 1)
    assert math.hypot(one.x_px - 40.3, one.y_px - 31.8) < 0.1
    assert one.z_nm == pytest.approx(z_nm, abs=2)


def test_what_is_explained_is_not_found_again() -> None:
    config = _at([_event(mass_kda=3000.0), _event(x_px=20.0, y_px=50.0)])
    assert len(_found(config, 2)[2]) >= 1
    assert _found(config, 2, explained=True)[2] == ()


@pytest.mark.parametrize("corner", [(0.0, 0.0), (79.0, 71.0), (0.3, 40.0)])
def test_particles_at_the_edge_are_found(corner: tuple[float, float]) -> None:
    _, _, found = _found(_at([_event(x_px=corner[0], y_px=corner[1], mass_kda=2000.0)]), 3)
    assert math.hypot(found[0].x_px - corner[0], found[0].y_px - corner[1]) < 1.5


def test_starts_are_finer_than_a_pixel() -> None:
    rng = np.random.default_rng(4)
    apart = []
    for seed, (x, y) in enumerate(rng.uniform(30, 40, (12, 2))):
        _, _, found = _found(_at([_event(x_px=x, y_px=y, mass_kda=2000.0)]), seed)
        apart.append(math.hypot(found[0].x_px - x, found[0].y_px - y))
        assert found[0].mass_kda == pytest.approx(2000.0, rel=0.1)
    # Rounding to whole pixels alone would give 0.38 on average.
    assert np.mean(apart) < 0.15


@pytest.mark.parametrize("mode", ["mass", "joint"])
@pytest.mark.parametrize("polarity", ["both", "dark", "bright"])
def test_polarity(polarity: str, mode: str) -> None:
    """A particle that lands darkens; one that leaves brightens."""
    sections = {"fit": {"mode": mode, "z_range_nm": [0.0, 60.0]}}
    events = [
        _event(mass_kda=2000.0),
        _event(frame=0, leave=200, x_px=20.0, y_px=52.0, mass_kda=2000.0),
    ]
    config = _at(events, detection={"polarity": polarity}, **sections)
    context, _, found = _found(config, 6)
    darkens = context.wide.peak_contrast(5.0, 2000.0) < 0
    assert darkens
    landed = [c for c in found if math.hypot(c.x_px - 40.3, c.y_px - 31.8) < 1]
    left = [c for c in found if math.hypot(c.x_px - 20.0, c.y_px - 52.0) < 1]
    if mode == "mass" or polarity != "bright":
        assert len(landed) == (polarity != "bright")
    if mode == "mass":
        assert len(left) == (polarity != "dark")
        assert all(c.mass_kda < 0 for c in left)
    assert all(c.mass_kda > 0 for c in landed)


def test_strongest_first() -> None:
    events = [_event(mass_kda=600.0), _event(x_px=10.0, y_px=60.0, mass_kda=1500.0)]
    found = _found(_at(events), 7)[2]
    assert [abs(c.snr) for c in found] == sorted((abs(c.snr) for c in found), reverse=True)
    assert found[0].x_px == pytest.approx(10.0, abs=1)


def test_masked_pixels_are_no_particles() -> None:
    config = _at([], detection={"false_alarms_per_movie": 1e-3})
    context = make_context(config, config.simulation.shape)
    windows = Light.of(Movie(config, seed=1), 200).draw(np.random.default_rng(1))
    windows = blank(windows, np.random.default_rng(2))
    after, masked = windows.after_e.copy(), windows.masked.copy()
    after[30:33, 40:43] = 0.0
    masked[30:33, 40:43] = True
    windows = replace(windows, after_e=after, masked=masked)
    likelihood = field_likelihood(context, windows)
    assert not find_particles(
        likelihood, context.templates, config.detection, roi_px=context.roi_px
    )
    snr, _ = signal_to_noise(likelihood, context.templates)
    assert np.isfinite(snr).all()
