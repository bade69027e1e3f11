"""The optics are tested before a movie is analysed, and what came of it is always said."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from calibrations import GRID, PHOTONS, configuration, make_particle_images, microscope
from scenes import PIXEL_NM, Stack, make_config
from scipy.ndimage import gaussian_filter, shift

import iscat_analysis as ia
from iscat_analysis.camera import camera_from_config
from iscat_analysis.config import Calibration, Config
from iscat_analysis.inference.counts import conditional
from iscat_analysis.inference.laws import CONDITIONAL
from iscat_analysis.instrument import learning
from iscat_analysis.instrument.learning import REJECTED_P, learn_optics, median_p, not_alone
from iscat_analysis.instrument.particle_image import Collected, ParticleImage
from iscat_analysis.instrument.uneven import FieldOfView, in_uneven_field
from iscat_analysis.optics.forward import PixelGrid, forward_model
from iscat_analysis.optics.parameters import settings_of

MOVIE: Any = SimpleNamespace(name="movie.tif", shape=(1000, 64, 64))


def _learn(
    monkeypatch: pytest.MonkeyPatch,
    changes: dict[str, Any],
    count: int,
    calibrate: str = "auto",
    *,
    noise_differs: bool = False,
) -> tuple[bool, dict[str, Any], list[str]]:
    """Whether the configuration stayed, the summary, and what the user was told."""
    config = _config(calibrate)
    images, _, _ = make_particle_images(changes, count, seed=3)
    learned, summary, said = _learned(monkeypatch, config, images, noise_differs=noise_differs)
    return learned == config, summary, said


def _learned(
    monkeypatch: pytest.MonkeyPatch,
    config: Config,
    images: list[ParticleImage],
    *,
    noise_differs: bool = False,
) -> tuple[Config, dict[str, Any], list[str]]:
    """Learn the optics of a movie with these bright particles."""
    monkeypatch.setattr(learning, "noise_differs", lambda *_: noise_differs)
    monkeypatch.setattr(learning, "bright_particle_images", lambda *_, **__: (images, []))
    camera = camera_from_config(config.camera, (64, 64), "uint16")
    learned, summary, findings = learn_optics(MOVIE, config, camera)
    return learned, summary, [finding.text for finding in findings]


def _config(calibrate: str) -> Config:
    config = configuration(calibrate=calibrate)
    sliding = config.background.model_copy(update={"method": "sliding"})
    return config.model_copy(update={"background": sliding})


def test_optics_that_describe_the_particles_stay_without_a_word(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stayed, summary, said = _learn(monkeypatch, {}, 14)
    assert stayed
    assert not said
    assert summary["tested"] == 14
    assert summary["median_p"] > REJECTED_P
    assert summary["calibrated"] is False


@pytest.mark.parametrize("y_nm", [0.0, 250.0])
def test_places_on_a_ring_do_not_condemn_the_optics(y_nm: float) -> None:
    """Out of focus the brightest spot may be of a ring, in all pictures alike."""
    config = configuration(focus_nm=-450.0)
    for changes, fits in (({}, True), ({"focus_nm": -300.0}, False)):
        images, _, _ = make_particle_images(changes, 8, seed=5, config=config)
        moved = [replace(image, y_nm=image.y_nm + y_nm) for image in images]
        assert (median_p(moved, config)[0] > REJECTED_P) == fits


def test_a_place_far_from_the_centre_of_its_picture_stops_nothing() -> None:
    """A bright spot between two particles may be half a micron away from either."""
    config = configuration()
    images, _, _ = make_particle_images({}, 6, seed=5, config=config)
    far = [replace(image, x_nm=500.0, y_nm=-500.0) for image in images[:2]]
    pairs, median = not_alone([*images[2:], *far], config)
    assert not pairs
    assert median > REJECTED_P


def test_nor_does_it_stop_the_test_of_an_uneven_field() -> None:
    config = configuration()
    images, _, _ = make_particle_images({}, 6, seed=5, config=config)
    far = [replace(images[0], x_nm=900.0, y_nm=-900.0), *images[1:]]
    view = FieldOfView((15.0, 15.0, 15.0), GRID.pixel_nm, (0, 1000), in_time=False, movie=MOVIE)
    assert in_uneven_field(Collected(config, far), settings_of(config), view) is None


def _pairs(changes: dict[str, Any], count: int, seed: int) -> list[ParticleImage]:
    """Draw pictures of two particles that landed at once, 0.3 to 1 µm apart."""
    config = configuration()
    model = microscope(config, changes)
    rng = np.random.default_rng(seed)
    images = []
    for _ in range(count):
        apart, angle = rng.uniform(300, 1000), rng.uniform(0, 2 * np.pi)
        first = model.image(GRID, 0.0, 0.0, 5.0, 2000.0)
        x, y = apart * np.cos(angle), apart * np.sin(angle)
        both = (1 + first) * (1 + model.image(GRID, x, y, 5.0, 2000.0))
        before, after = rng.poisson(PHOTONS, GRID.shape), rng.poisson(PHOTONS * both)
        data = conditional(model, GRID, before.astype(float), after.astype(float), 1.0).data
        images.append(
            ParticleImage(GRID, CONDITIONAL, data, x / 2, y / 2, 5.0, mass_kda=0.0, snr=1e3)
        )
    return images


@pytest.mark.parametrize(("changes", "fits"), [({}, True), ({"z11": 25.0}, False)])
def test_pairs_that_land_at_once_do_not_condemn_the_optics(
    changes: dict[str, Any], fits: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Six of eleven bright places are two particles; control: wrong optics, which are learned."""
    config = _config("auto")
    singles, _, _ = make_particle_images(changes, 5, seed=3)
    images = [*_pairs(changes, 6, 4), *singles]
    learned, summary, said = _learned(monkeypatch, config, images)
    assert (learned == config) == fits
    assert abs(learned.optics.aberrations_nm.get("z11", 0.0) - changes.get("z11", 0.0)) < 3.0
    assert (summary["median_p"] > REJECTED_P) == fits
    assert summary["tested"] == (11 if not fits else 5)
    assert bool(said) != fits


def _sigma(summary: dict[str, Any], name: str) -> float:
    """Give the standard deviation of a parameter of the optics of an analysis."""
    k = summary["names"].index(name)
    assert len(summary["values"]) == len(summary["names"]) == len(summary["covariance"])
    return float(summary["covariance"][k][k]) ** 0.5


@pytest.mark.parametrize("noise_differs", [False, True])
@pytest.mark.parametrize("calibrate", ["auto", "always"])
def test_a_movie_without_bright_particles_keeps_the_usual_errors(
    calibrate: str, noise_differs: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    stayed, summary, said = _learn(monkeypatch, {}, 0, calibrate, noise_differs=noise_differs)
    assert stayed
    assert len(said) == 1
    why = "its noise is not" if noise_differs and calibrate == "auto" else "movie.tif: shows no "
    assert said[0].startswith(f"the optics cannot be tested on this movie: {why}")
    assert said[0].endswith("the analysis goes on as configured")
    assert summary["tested"] == 0
    assert summary["calibrated"] is False
    for name, usual in (("focus_nm", 150.0), ("na", 0.01), ("z11", 20.0)):
        assert _sigma(summary, name) == pytest.approx(usual)


@pytest.mark.parametrize("count", [1, 3])
def test_few_particles_that_the_configured_optics_describe_confirm_them(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One was not even looked at."""
    stayed, summary, said = _learn(monkeypatch, {}, count)
    assert stayed
    assert not said
    assert summary["tested"] == count
    assert _sigma(summary, "focus_nm") < 15.0


@pytest.mark.parametrize("count", [1, 8])
@pytest.mark.parametrize("changes", [{"focus_nm": -400.0}, {"z11": 25.0}])
def test_few_particles_move_the_optics(
    changes: dict[str, float], count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fewer than twelve were refused."""
    stayed, summary, said = _learn(monkeypatch, changes, count)
    assert not stayed
    assert summary["calibrated"]
    assert f"from {count} particle" in said[0]
    rows = {row["parameter"]: row for row in summary["parameters"]}
    for name, value in changes.items():
        assert abs(rows[name]["value"] - value) < max(4 * rows[name]["sigma"], 0.1)
        assert summary["values"][summary["names"].index(name)] == rows[name]["value"]
        assert _sigma(summary, name) == pytest.approx(rows[name]["sigma"])
    assert all(row["sigma"] is not None for row in rows.values() if row["state"] != "given")


def test_usual_errors_can_be_others(monkeypatch: pytest.MonkeyPatch) -> None:
    config = _config("auto")
    known = config.uncertainty.model_copy(update={"optics": {"focus_nm": 2.0}})
    sure = config.model_copy(update={"uncertainty": known})
    _, summary, _ = _learned(monkeypatch, sure, [])
    assert _sigma(summary, "focus_nm") == pytest.approx(2.0)
    assert _sigma(summary, "na") == pytest.approx(0.01)
    with pytest.raises(ia.ConfigError, match="focus cannot be learned: give some of focus_nm"):
        ia.configure(settings={"uncertainty.optics": {"focus": 2.0}})


@pytest.mark.parametrize("focus_nm", [-380.0, pytest.param(300.0, marks=pytest.mark.large)])
def test_a_phase_that_the_line_of_masses_turns_is_told(
    monkeypatch: pytest.MonkeyPatch, focus_nm: float
) -> None:
    """Beyond focus particles are bright; the control is on the configured side."""
    images, _, _ = make_particle_images({"focus_nm": focus_nm}, 16, seed=3)
    line = {"calibration": Calibration(gradient_per_kda=-3.1e-5)}
    learned, summary, said = _learned(monkeypatch, _config("auto").model_copy(update=line), images)
    phase = learned.optics.reference_phase_deg
    assert summary["calibrated"]
    assert abs(learned.optics.focus_nm - focus_nm) < 50
    (row,) = [r for r in summary["parameters"] if r["parameter"] == "reference_phase_deg"]
    assert row["value"] == phase
    headline = re.search(r"phase (\S+) ±", said[0])
    assert headline is not None
    assert float(headline[1]) == pytest.approx(phase, abs=0.1)
    turned = [text for text in said if "half a turn" in text]
    assert (abs(phase) > 90) == bool(turned) == (focus_nm > 0)
    assert not turned or "with which particles brighten the image" in turned[0]
    assert set(turned) <= set(summary["notes"])


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"optics.scheme": "darkfield", "particle.photons_per_frame": 1e4}, "from dark field"),
        ({"optics.convention": "dong2021"}, 'with optics.convention = "dong2021"'),
        ({"background.method": "known", "background.level_e": 1e4}, 'background.method = "known"'),
        ({"fit.mode": "joint"}, "in mode joint without background frames"),
        ({"fit.mode": "track", "background.frames": [0, 5]}, "not learned with the tracks"),
        (
            {"fit.mode": "track", "track.free": "joint", "optics.convention": "dong2021"},
            'with optics.convention = "dong2021"',
        ),
    ],
)
def test_always_is_told_where_nothing_is_learned_from_such_movies(
    settings: dict[str, Any], reason: str
) -> None:
    camera = camera_from_config(_config("always").camera, (64, 64), "uint16")
    for calibrate in ("always", "auto"):
        config = ia.configure(settings={"optics.calibrate": calibrate, **settings})
        learned, summary, findings = learn_optics(MOVIE, config, camera)
        assert (learned, summary) == (config, {})
        assert len(findings) == (calibrate == "always")
        assert all(reason in finding.text for finding in findings)


def test_never_looks_at_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    stayed, summary, said = _learn(monkeypatch, {"z11": 25.0}, 14, "never")
    assert stayed
    assert not summary
    assert not said


@pytest.mark.parametrize(
    ("focus_nm", "gain", "said_first"),
    [
        (-300.0, 1.0, ""),
        pytest.param(-420.0, 1.0, "optics learned from the movie", marks=pytest.mark.large),
        (-300.0, 2.0, "the optics cannot be tested on this movie: its noise"),
    ],
)
def test_neither_rings_of_neighbours_nor_the_gain_condemn_the_optics(
    focus_nm: float, gain: float, said_first: str
) -> None:
    """Six bright particles bound at once, 2 µm from each other, each among the rings of all."""
    config = make_config(background={"frames": [0, 2]}, fit={"frames": [2, 4]})
    true = make_config(optics={"focus_nm": focus_nm})
    side, rng = 90, np.random.default_rng(2)
    grid = PixelGrid.region((0, side), (0, side), PIXEL_NM)
    model = forward_model(true, grid.diagonal_nm)
    signal = sum(
        model.image(grid, x * PIXEL_NM, y * PIXEL_NM, 5.0, 500.0)
        for x in (19.2, 45.1, 71.4)
        for y in (28.3, 60.9)
    )
    light = np.repeat([np.full(grid.shape, 3e7), 3e7 * (1 + signal)], 2, axis=0)
    counts = (rng.poisson(light) / gain).astype(np.uint32)
    unsaturated = config.model_copy(
        update={"camera": config.camera.model_copy(update={"well_depth_e": 1e9})}
    )
    camera = camera_from_config(unsaturated.camera, grid.shape, counts.dtype)
    movie: Any = Stack(counts)
    _, summary, findings = learn_optics(movie, unsaturated, camera)
    said = [finding.text for finding in findings]
    assert summary["tested"] == 6
    assert summary["calibrated"] == (focus_nm < -400.0)
    assert bool(said) == bool(said_first)
    assert not said or said[0].startswith(said_first)


def test_particles_at_heights_of_their_own_do_not_condemn_the_optics(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The test takes them for particles at particle.height_nm, which these modes do not."""
    config = _config("auto")
    images, _, _ = make_particle_images({"focus_nm": -450.0}, 8, seed=3)
    for mode in ("joint", "localize"):
        free = config.model_copy(update={"fit": config.fit.model_copy(update={"mode": mode})})
        assert _learned(monkeypatch, free, images) == (free, {}, [])
    assert "learned" in _learned(monkeypatch, config, images)[2][0]  # control: one height for all


@pytest.mark.parametrize(
    ("moved_px", "why"), [(0.5, "edges of a fixed pattern"), (0.0, "shows no bright")]
)
def test_edges_of_a_pattern_that_moved_are_not_learned_from(moved_px: float, why: str) -> None:
    """Where every particle has a height of its own, they would be fitted as if they were some."""
    config = make_config(
        background={"frames": [0, 10]}, fit={"frames": [10, 20], "mode": "joint"}
    )  # fmt: skip
    rng = np.random.default_rng(4)
    speckle = gaussian_filter(rng.standard_normal((64, 64)), 2.0, mode="wrap")
    light = 1e5 * (1 + 0.1 * speckle / speckle.std())
    later = shift(light, (moved_px, 0.0), mode="wrap")
    counts = rng.poisson(np.repeat([light, later], 10, axis=0)).astype(np.uint32)
    camera = config.camera.model_copy(update={"well_depth_e": 1e9})
    unsaturated = config.model_copy(update={"camera": camera})
    movie: Any = Stack(counts)
    found = learn_optics(movie, unsaturated, camera_from_config(camera, (64, 64), counts.dtype))
    assert not found.summary["calibrated"]
    (finding,) = found.findings
    assert why in finding.text


def test_a_median_has_its_own_noise_when_optics_are_tested(tmp_path: Path) -> None:
    """With the variance of a mean the right optics were rejected: p-values of 1e-5 and less."""
    events = [
        {"frame": 60, "x_px": 22.3 + 40 * (k % 2), "y_px": 21.6 + 40 * (k // 2), "mass_kda": 1000.0}
        for k in range(4)
    ]
    setup = {
        "camera.pixel_size_nm": PIXEL_NM,
        "background.frames": (0, 60),
        "fit.frames": (60, 120),
        "calibration.gradient_per_kda": -3.1e-5,
        "posterior.enabled": False,
        "compute.workers": 1,
    }
    light = {
        "simulation.shape": (84, 84),
        "simulation.frames": 120,
        "simulation.photons_per_pixel": 3e4,
        "simulation.events": events,
    }
    ia.simulate_movie({**setup, **light}, tmp_path / "movie.tif", seed=2)
    result = ia.fit_movie(tmp_path / "movie.tif", config={**setup, "background.method": "median"})
    assert result.summary["optics"]["tested"] == 4
    assert result.summary["optics"]["median_p"] > 10 * REJECTED_P
    assert not [text for text in result.warnings if "optics" in text]
