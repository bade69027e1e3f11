"""Light that changes smoothly over the field: found, divided out, and seen through by fits."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import PIXEL_NM, make_config
from scipy.ndimage import fourier_shift, gaussian_filter
from wanderers import SETTINGS, wander

import iscat_analysis as ia
from iscat_analysis.camera import Camera, LightModel, find_light
from iscat_analysis.camera.light import Seams, Smooth
from iscat_analysis.fitting.context import make_context
from iscat_analysis.optics.pixels import PixelGrid
from iscat_analysis.study import Movie

Array = NDArray[np.float64]

SHAPE = (96, 128)
LEVEL_E, WINDOW, FRAMES, PAIRS = 1e5, 50, 1, 12
Y, X = (k / (n / 2) - 1 for k, n in zip(np.indices(SHAPE), SHAPE, strict=True))


def _light(grain_px: float = 2.0) -> Array:
    rough = gaussian_filter(np.random.default_rng(1).standard_normal(SHAPE), grain_px, mode="wrap")
    return np.asarray(LEVEL_E * (1 + 0.1 * rough / rough.std()))


def _pairs(light: list[tuple[Array, Array]], seed: int) -> list[tuple[Array, Array]]:
    """Draw sums of frames of the light before and after, as one frame with a gain of its own."""
    rng = np.random.default_rng(seed)
    return [
        tuple(  # type: ignore[misc]
            np.stack([k * (1 + 0.02 * rng.standard_normal())] * FRAMES)
            + np.sqrt(k) * rng.standard_normal((FRAMES, *SHAPE))
            for k in two
        )
        for two in light
    ]


def _changed(factor: Array, grain_px: float = 2.0) -> list[tuple[Array, Array]]:
    light = _light(grain_px)
    return [(light, light * factor), (light * factor, light)] * (PAIRS // 2)


def test_a_polynomial_is_measured_exactly() -> None:
    light = _light()
    light[10, 20] = 0.0  # not used
    factor = 1 + 0.02 * X - 0.01 * Y**2 * X + 0.03 * X * Y
    factor /= np.average(factor, weights=light)
    np.testing.assert_allclose(
        LightModel(light, Smooth(3)).factors(light * factor), factor, atol=1e-12
    )
    assert np.abs(LightModel(light, Smooth(2)).factors(light * factor) - factor).max() > 1e-4


@pytest.mark.parametrize(
    ("factor", "degrees"),
    [
        (1 + 5e-4 * X, (1, 1)),
        (1 + 2e-3 * X * Y, (2, 3)),
        (1 + 1e-2 * np.sin(2 * np.pi * (X + 0.3 * Y)), (7, 12)),
    ],
)
def test_smooth_changes_are_found_with_their_size(factor: Array, degrees: tuple[int, int]) -> None:
    found = find_light(_pairs(_changed(factor), 2), Camera(), WINDOW)
    assert found is not None
    assert degrees[0] <= found.smooth.degree <= degrees[1]
    weight = _light()
    spread = np.sqrt(np.average((factor - np.average(factor, weights=weight)) ** 2, weights=weight))
    assert found.smooth.rms == pytest.approx(spread, rel=0.05)


def _fringes(period_px: float, phase: float, bent: float = 0.0) -> Array:
    way = 0.8 * X * SHAPE[1] / 2 + 0.6 * Y * SHAPE[0] / 2
    steep = np.exp(-bent * (X**2 + Y**2))
    return 1 + 1e-2 * steep * np.cos(2 * np.pi * way / period_px + bent * X * Y + phase)


@pytest.mark.parametrize(
    ("period_px", "bent"), [(12.0, 0.0), (25.0, 0.0), (34.0, 0.0), (20.0, 0.7)]
)
def test_fringes_are_found_and_measured(period_px: float, bent: float) -> None:
    """Where they are bent as well as straight, as deep everywhere as in the middle."""
    phases = np.random.default_rng(8).uniform(0, 2 * np.pi, (PAIRS, 2))
    light = [
        (_light() * _fringes(period_px, one, bent), _light() * _fringes(period_px, other, bent))
        for one, other in phases
    ]
    found = find_light(_pairs(light, 8), Camera(), WINDOW)
    assert found is not None
    assert found.fringes.periods_px == pytest.approx([period_px], rel=0.01)
    assert bool(found.fringes.degree) == bool(bent)
    factor = _fringes(period_px, 1.0, bent)
    left = found.factors(found.light_e * factor) / factor
    assert left.std() < (0.03 if bent else 0.01) * factor.std()


@pytest.mark.parametrize("seams", [((40,), ()), ((), (64,)), ((48,), (64,)), ((), (32, 64, 96))])
def test_parts_of_a_camera_are_told_by_their_seams(
    seams: tuple[tuple[int, ...], tuple[int, ...]],
) -> None:
    rng = np.random.default_rng(9)
    parts = [
        np.repeat(np.arange(len(cuts) + 1), np.diff([0, *cuts, n]))
        for cuts, n in zip(seams, SHAPE, strict=True)
    ]

    def gains() -> Array:
        drawn = 1 + 3e-3 * rng.standard_normal([len(cuts) + 1 for cuts in seams])
        return np.asarray(drawn[np.ix_(*parts)])

    light = [(_light() * gains(), _light() * gains()) for _ in range(2 * PAIRS)]
    found = find_light(_pairs(light, 9), Camera(), WINDOW)
    assert found is not None
    assert (found.seams.rows, found.seams.columns) == seams
    factor = gains()
    factor /= np.average(factor, weights=found.light_e)
    np.testing.assert_allclose(found.factors(found.light_e * factor), factor, atol=1e-9)


def test_seams_and_fringes_hide_nothing_from_each_other() -> None:
    rng = np.random.default_rng(10)

    def light() -> Array:
        halves = np.repeat(1 + 5e-3 * rng.standard_normal((2, 1)), SHAPE[0] // 2, axis=0)
        return np.asarray(_light() * halves * _fringes(25.0, rng.uniform(0, 6)))

    found = find_light(_pairs([(light(), light()) for _ in range(PAIRS)], 10), Camera(), WINDOW)
    assert found is not None
    assert found.seams == Seams((48,), ())
    assert found.fringes.periods_px == pytest.approx([25.0], rel=0.01)


def test_nothing_is_found_in_steady_light() -> None:
    still = [(_light(), _light())] * PAIRS
    assert all(find_light(_pairs(still, seed), Camera(), WINDOW) is None for seed in range(12))


def test_particles_and_pixels_that_blink_are_no_light() -> None:
    """Six bright ones land between the frames of every pair, 3 % dark; ten pixels blink."""
    rng = np.random.default_rng(3)
    light = []
    for _ in range(PAIRS):
        factor = np.ones(SHAPE)
        for y, x in zip(rng.uniform(0, 96, 6), rng.uniform(0, 128, 6), strict=True):
            factor -= 0.03 * np.exp(-(((Y + 1) * 48 - y) ** 2 + ((X + 1) * 64 - x) ** 2) / 2)
        factor[rng.integers(0, 96, 10), rng.integers(0, 128, 10)] *= 1.5
        light.append((_light(), _light() * factor))
    assert find_light(_pairs(light, 4), Camera(), WINDOW) is None


def test_dust_that_lands_is_no_light() -> None:
    """Its rim is smooth, and it is nowhere but in one pair."""
    dust = 1 - 0.3 * np.exp(-((64 * X + 20) ** 2 + (48 * Y - 10) ** 2) / (2 * 6**2))
    light = [(_light(), _light() * (dust if k == 5 else 1)) for k in range(PAIRS)]
    assert find_light(_pairs(light, 11), Camera(), WINDOW) is None


def test_what_is_added_to_all_pixels_is_taken_off() -> None:
    added = 0.02 * LEVEL_E
    light = [(_light(), _light() + added), (_light() + added, _light())] * (PAIRS // 2)
    found = find_light(_pairs(light, 12), Camera(), WINDOW)
    assert found is not None
    assert found.smooth.degree == 0
    assert found.added == pytest.approx(0.02, rel=0.15)
    frame = found.light_e + added
    even = frame / found.factors(frame) / found.light_e
    assert np.std(even) < 1e-9 < np.std(frame / found.light_e)


@pytest.mark.parametrize("count", [1, 300])
def test_particles_on_light_without_a_pattern_are_nothing_that_is_added(count: int) -> None:
    rng = np.random.default_rng(13)
    factor = np.ones(SHAPE)
    for y, x in zip(rng.uniform(0, 96, count), rng.uniform(0, 128, count), strict=True):
        factor -= 0.02 * np.exp(-(((Y + 1) * 48 - y) ** 2 + ((X + 1) * 64 - x) ** 2) / 4)
    flat = np.full(SHAPE, LEVEL_E)
    assert find_light(_pairs([(flat, flat * factor)] * PAIRS, 13), Camera(), WINDOW) is None


@pytest.mark.parametrize("grain_px", [1.5, 4.0])
def test_a_pattern_that_moves_is_not_taken_for_light(grain_px: float) -> None:
    still = _light(grain_px)
    moved = np.fft.ifft2(fourier_shift(np.fft.fft2(still), (0.1, 0.25))).real
    assert find_light(_pairs([(still, moved)] * PAIRS, 5), Camera(), WINDOW) is None


def test_what_is_left_of_a_particle_is_foreseen() -> None:
    """The polynomial takes a part of its light; frames say the same as the model."""
    context = make_context(make_config(), SHAPE)
    grid = PixelGrid.region((0, SHAPE[0]), (0, SHAPE[1]), PIXEL_NM)
    signal = context.wide.image(grid, 9 * PIXEL_NM, 7 * PIXEL_NM, 5.0, 1000.0)
    lines = LightModel(_light(), Smooth(10))
    changed = 1 + 0.01 * X * Y
    frames = _light() * changed * np.stack([np.ones(SHAPE), 1 + signal])
    before, after = (f / f.sum() for f in frames / lines.factors(frames))
    gained = np.average(1 + signal, weights=_light())
    left = after / before * gained - 1
    peak = np.unravel_index(int(np.abs(signal).argmax()), SHAPE)
    np.testing.assert_allclose(
        left, (1 + signal) / lines.taken(signal) - 1, atol=2e-3 * abs(signal[peak])
    )
    assert abs(left[peak] / signal[peak] - 1) > 0.01  # control: near a corner it is not nothing


def test_particles_that_land_in_wandering_light(monkeypatch: pytest.MonkeyPatch) -> None:
    """All are found and ok, and nothing else; without the correction they are poor fits."""
    places = [(20.0, 20.0), (44.0, 20.0), (20.0, 44.0), (44.0, 44.0)]
    events = [
        {"frame": 55 + 12 * i, "x_px": x, "y_px": y, "mass_kda": 500.0}
        for i, (x, y) in enumerate(places)
    ]
    config = make_config(
        background={"method": "sliding", "frames": None, "window_frames": 40},
        fit={"frames": None, "spheres": []}, camera={"gain_e_per_adu": 4.0},
        optics={"calibrate": "never"}, detection={"false_alarms_per_movie": 1e-3},
        simulation={"shape": [64, 64], "frames": 150, "photons_per_pixel": 1e5, "events": events},
    )  # fmt: skip
    rng = np.random.default_rng(7)
    x = np.linspace(-1, 1, 64)
    tilt = [1 + 0.02 * np.sin(t / 40) * x + 0.01 * np.cos(t / 30) * x[:, None] for t in range(150)]
    light = np.array(list(Movie(config, 6).expected_frames())) * tilt
    counts = np.round(rng.poisson(light) / 4).astype(np.uint16)
    result = ia.fit_movie(counts, config=config)
    table = result.table
    assert list(table["status"]) == ["ok"] * 4
    assert (abs(table["mass_kda"] - 500.0) < 4 * table["sigma_mass_kda"]).all()
    assert result.summary["lines"]["smooth_degree"] >= 1
    assert any("changes slowly over the field" in text for text in result.warnings)
    monkeypatch.setattr("iscat_analysis.diagnosis.light.find_light", lambda *_: None)
    without = ia.fit_movie(counts, config=config)
    assert (without.table["status"] == "ok").sum() < 2


def test_fringes_that_change_between_a_background_and_what_follows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As where the laser hops to another mode: within either they stand still."""
    config = make_config(
        background={"method": "fixed", "frames": [0, 40]}, fit={"frames": [40, 80], "spheres": []},
        camera={"gain_e_per_adu": 4.0}, optics={"calibrate": "never"},
        simulation={
            "shape": [64, 64], "frames": 80, "photons_per_pixel": 1e5,
            "events": [{"frame": 40, "x_px": 30.0, "y_px": 34.0, "mass_kda": 500.0}],
        },
    )  # fmt: skip
    y, x = np.indices((64, 64))
    phase = np.where(np.arange(80) < 40, 0.0, 2.0)[:, None, None]
    fringes = 1 + 0.01 * np.cos(2 * np.pi * (0.8 * x + 0.6 * y) / 16 + phase)
    light = np.array(list(Movie(config, 6).expected_frames())) * fringes
    counts = np.round(np.random.default_rng(6).poisson(light) / 4).astype(np.uint16)
    result = ia.fit_movie(counts, config=config)
    assert list(result.table["status"]) == ["ok"]
    row = result.table.iloc[0]
    assert abs(row["mass_kda"] - 500) < 4 * row["sigma_mass_kda"]
    assert result.summary["lines"]["fringe_periods_px"] == pytest.approx([16.0], rel=0.01)
    monkeypatch.setattr("iscat_analysis.diagnosis.light.find_light", lambda *_: None)
    without = ia.fit_movie(counts, config=config)
    assert list(without.table["status"]) != ["ok"]


def test_a_particle_that_moves_in_wandering_light() -> None:
    """The spot is a Gaussian as wide as the field, whose centre goes where it likes."""
    frames, side = 100, 64
    steps = np.random.default_rng(7).standard_normal((frames, 2))
    way = 4.0 * np.cumsum(steps, axis=0) / np.sqrt(frames)
    y, x = np.indices((side, side)) - (side - 1) / 2

    def spot(t: int) -> Array:
        return np.asarray(np.exp((x * way[t, 0] + y * way[t, 1]) / (0.6 * side) ** 2))

    shape = (frames, side, side)
    movie = wander(shape, seed=5, species=((300.0, 0.3, 1),), shade=spot)
    result = ia.fit_movie(movie.counts, settings=SETTINGS)
    assert any("changes slowly over the field" in text for text in result.warnings)
    assert list(result.tracks["status"]) == ["ok"]
    track = result.tracks.iloc[0]
    assert abs(track["mass_kda"] - 300) < 4 * track["sigma_mass_kda"]
    both = result.table.merge(movie.truth, on="frame", suffixes=("", "_true"))
    for axis in ("x_nm", "y_nm"):
        pull = (both[axis] - both[f"{axis}_true"]) / both[f"sigma_{axis}"]
        assert abs(pull.std() - 1) < 4 / np.sqrt(2 * len(pull))
