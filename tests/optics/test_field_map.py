"""A microscope that is not the same everywhere, and light that is not one plane wave."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.special import roots_legendre

from iscat_analysis.config import Config, load_config
from iscat_analysis.errors import ConfigError
from iscat_analysis.fitting.context import AnalysisContext, make_context
from iscat_analysis.inference.counts import asimov_poisson
from iscat_analysis.instrument.particle_image import ParticleImage, build_microscope
from iscat_analysis.optics.forward import PixelGrid, forward_model
from iscat_analysis.optics.local import WEIGHTS, LocalModels, Spot
from iscat_analysis.optics.parameters import FIELD, settings_of
from iscat_analysis.study import Movie

ROOT = Path(__file__).resolve().parents[2]

PIXEL_NM = 84.0
FIELD_PX = (101, 101)
GRID = PixelGrid.centred(25, PIXEL_NM)
REACH_NM = 2000.0


def _config(*settings: str, **optics: Any) -> Config:
    given = [f"optics.{key}={value}" for key, value in optics.items()]
    return load_config(
        None, [f"camera.pixel_size_nm={PIXEL_NM}", "particle.mass_kda=480", *settings, *given]
    )


def _image(config: Config, mass_kda: float = 480.0) -> np.ndarray:
    return forward_model(config, REACH_NM).image(GRID, 12.0, -20.0, 5.0, mass_kda)


def _local(config: Config, x_px: float, y_px: float, frame: int | None = None) -> np.ndarray:
    models = LocalModels(config, forward_model(config, REACH_NM), FIELD_PX)
    at = models.at(x_px * PIXEL_NM, y_px * PIXEL_NM, frame)
    return at.image(GRID, 12.0, -20.0, 5.0, 480.0)


@pytest.mark.parametrize(
    ("terms", "there"),
    [
        ({"focus_tilt_nm": "[80, -40]"}, {"focus_nm": -300 + 80 * 0.5 - 40 * -0.25}),
        ({"focus_curvature_nm": "64"}, {"focus_nm": -300 + 64 * 0.3125}),
        ({"coma_field_nm": "16"}, {"aberrations_nm": "{z8=8.0,z7=-4.0}"}),
        ({"astigmatism_field_nm": "[8, 16]"}, {"aberrations_nm": "{z6=8.0,z5=6.0}"}),
        ({"phase_tilt_deg": "[12, 4]"}, {"reference_phase_deg": 12 * 0.5 - 4 * 0.25}),
        ({"phase_curvature_deg": "16"}, {"reference_phase_deg": 16 * 0.3125}),
        ({"focus_drift_nm": "50", "focus_frame": "100"}, {"focus_nm": -300 + 50 * 0.4}),
        ({"focus_bend_nm": "-200", "focus_frame": "100"}, {"focus_nm": -300 - 200 * 0.16}),
        ({"focus_jumps": "[[300, 60], [500, -35], [501, 80]]"}, {"focus_nm": -300 + 60 - 35}),
    ],
)
def test_a_particle_is_seen_with_the_optics_of_its_place(
    terms: dict[str, str], there: dict[str, Any]
) -> None:
    """At half a field to the right of the centre, a quarter above it, in frame 500."""
    field = {"field_px": "[50, 50, 40]", "focus_nm": -300}
    found = _local(_config(**terms, **field), 50 + 20, 50 - 10, 500)
    expected = _image(_config(**{"focus_nm": -300, **there}))
    peak = np.abs(expected).max()
    assert np.abs(found - expected).max() < 0.002 * peak  # half a step of `STEPS`
    middle = _image(_config(focus_nm=-300))
    assert np.abs(_local(_config(**terms, **field), 50, 50, 100) - middle).max() < 1e-9 * peak
    assert np.abs(expected - middle).max() > 0.01 * peak  # it is another picture


def test_a_brighter_reference_dims_the_interference_and_more_so_the_light_itself() -> None:
    """Amplitude of the reference times 1.1: contrast a P + a² Q becomes a P/1.1 + a² Q/1.21."""
    config = _config(reference_tilt="[0.1, 0]")
    models = LocalModels(config, forward_model(config, REACH_NM), FIELD_PX)
    bright = models.at((50 + 50.5) * PIXEL_NM, 50 * PIXEL_NM)
    even = forward_model(_config(), REACH_NM)
    both = [even.amplitude_image(GRID, 0, 0, 5.0, a) for a in (1.0, -1.0)]
    p, q = (both[0] - both[1]) / 2, (both[0] + both[1]) / 2
    found = bright.amplitude_image(GRID, 0, 0, 5.0, 1.0)
    assert np.allclose(found, p / 1.1 + q / 1.21, rtol=0, atol=1e-12 * np.abs(p).max())


def test_the_learner_knows_how_pictures_change_with_a_coefficient() -> None:
    """The parameters of a picture, and their slopes, are those of its place and time."""
    settings = settings_of(_config())
    light = asimov_poisson(forward_model(_config(), REACH_NM), GRID, np.zeros(5), 1.0, 1.0)
    image = ParticleImage(
        GRID, light.noise, light.data, 0.0, 0.0, 5.0, focus_steps=0.3, place=(0.6, -0.4),
        after=(False, True),
    )  # fmt: skip
    assert image.spot == Spot(0.6, -0.4, 0.3, (False, True))
    for name in (*FIELD, "focus_drift_nm", "focus_bend_nm", "focus_jump_2_nm"):
        low, high = (image.seen_with({**settings, name: size}) for size in (0.0, 2.0))
        slopes = {k: (high[k] - low[k]) / 2 for k in low if isinstance(low[k], float)}
        expected = {key: image.slopes(name).get(key, 0.0) for key in slopes}
        assert slopes == pytest.approx(expected)
        assert any(expected.values())
    assert set(FIELD) < set(WEIGHTS)


@pytest.mark.parametrize(
    ("moves", "frames"),
    [
        ({"focus_jumps": "[[3, 80]]"}, {1: -300, 3: -220}),
        ({"focus_drift_nm": "20000", "focus_frame": "1"}, {1: -300, 4: -240}),
        ({"focus_bend_nm": "5e6", "focus_frame": "1"}, {1: -300, 5: -220}),
    ],
)
def test_a_simulated_focus_moves(moves: dict[str, str], frames: dict[int, float]) -> None:
    """What has landed before changes with it."""
    scene = (
        "simulation.shape=[31, 31]", "simulation.frames=6", 'simulation.background="flat"',
        "simulation.power_noise=0", "simulation.photons_per_pixel=1000",
        "simulation.events=[{frame=1,x_px=15.0,y_px=15.0,mass_kda=480.0,z_nm=5.0}]",
        "background.method=sliding",
    )  # fmt: skip
    seen = list(Movie(_config(*scene, focus_nm=-300, **moves), 1).expected_frames())
    grid = PixelGrid.region((0, 31), (0, 31), PIXEL_NM)
    for frame, focus in frames.items():
        model = forward_model(_config(focus_nm=focus), 6000.0)
        expected = model.image(grid, 15 * PIXEL_NM, 15 * PIXEL_NM, 5.0, 480.0)
        assert np.abs(seen[frame] / seen[0] - 1 - expected).max() < 0.002 * np.abs(expected).max()


def test_one_model_for_the_whole_field_is_refused_where_optics_differ() -> None:
    for settings in (["fit.mode=track", "background.method=tracks"],):
        with pytest.raises(ConfigError, match="focus_tilt_x_nm"):
            make_context(_config(*settings, focus_tilt_nm="[30, 0]"), FIELD_PX)


def _cone(illumination_na: float, mass_kda: float) -> np.ndarray:
    """Average over plane waves that do not interfere, one after the other."""
    model = forward_model(_config(), REACH_NM)
    x, y = np.meshgrid(GRID.x_nm - 12.0, GRID.y_nm + 20.0)
    field = model.field(x, y, 5.0, mass_kda)
    k = 2 * np.pi / model.optics.wavelength_nm
    points, weights = roots_legendre(6)
    total = np.zeros(GRID.shape)
    for area, weight in zip((points + 1) / 2, weights / 2, strict=True):
        for angle in 2 * np.pi * np.arange(16) / 16:
            q = k * illumination_na * np.sqrt(area)
            turn = np.exp(1j * q * (np.cos(angle) * x + np.sin(angle) * y))
            waves = np.stack([turn + field[0], field[1]])
            total += weight / 16 * (np.sum(np.abs(waves) ** 2, axis=0) - 1)
    return total


@pytest.mark.parametrize("mass_kda", [480.0, 2e6])
def test_a_cone_of_light_is_the_average_of_its_plane_waves(mass_kda: float) -> None:
    expected = _cone(0.15, mass_kda)
    points = "camera.samples_per_pixel=1"  # where the waves are added
    found = _image(_config(points, illumination_na=0.15), mass_kda)
    peak = np.abs(expected).max()
    assert np.abs(found - expected).max() < 1e-6 * peak
    assert np.abs(_image(_config(), mass_kda) - expected).max() > 0.01 * peak


def test_a_spectrum_is_the_average_of_its_wavelengths() -> None:
    """Thirteen wavelengths; the material is that of the middle, the dipole radiates as λ⁻³."""
    config, width = _config(bandwidth_nm=20.0), 20.0 / 2.354820045
    nodes, shares = np.polynomial.hermite_e.hermegauss(13)
    middle = forward_model(_config(), REACH_NM)
    total = np.zeros(GRID.shape)
    for node, share in zip(nodes, shares / shares.sum(), strict=True):
        model = forward_model(_config(wavelength_nm=525.0 + width * node), REACH_NM)
        dipole = (525.0 / (525.0 + width * node)) ** 3 * abs(middle.factor / model.factor)
        amplitude = middle.nominal_amplitude * dipole
        total += share * model.amplitude_image(GRID, 12.0, -20.0, 5.0, amplitude)
    peak = np.abs(total).max()
    assert np.abs(_image(config) - total).max() < 3e-5 * peak
    assert np.abs(_image(_config()) - total).max() > 1e-3 * peak


def test_derivatives_of_partly_coherent_light_are_those_of_its_picture() -> None:
    config = _config(illumination_na=0.15, bandwidth_nm=15.0)
    model, place = forward_model(config, REACH_NM), np.array([12.0, -20.0, 5.0])
    amplitude = 50 * model.nominal_amplitude
    signal, slopes = model.signal(GRID, (*place, amplitude), ("focus_nm", "z8"))
    own, shared = slopes[:4], slopes[4:]
    image = model.amplitude_image(GRID, *place, amplitude)
    peak = np.abs(image).max()
    assert np.abs(signal - image).max() < 1e-6 * peak
    gradient = model.signal(GRID, (*place, amplitude))[1]
    second = model.amplitude_hessian(GRID, *place, amplitude)[2]
    for axis in range(3):
        step = np.eye(3)[axis] * 0.01
        up, down = (model.signal(GRID, (*(place + sign * step), amplitude)) for sign in (1, -1))
        slope = (up[0] - down[0]) / 0.02
        assert np.abs(gradient[axis] - slope).max() < 1e-6 * np.abs(slope).max()
        assert np.abs(own[axis] - slope).max() < 1e-5 * np.abs(slope).max()
        bend = (up[1] - down[1]) / 0.02
        assert np.abs(second[axis] - bend).max() < 1e-5 * np.abs(bend).max()
    settings = settings_of(config)
    for change, (name, step) in zip(shared, (("focus_nm", 0.1), ("z8", 0.05)), strict=True):
        up, down = (
            build_microscope(config, REACH_NM, {**settings, name: settings[name] + size})
            .amplitude_image(GRID, *place, amplitude)
            for size in (step, -step)
        )  # fmt: skip
        slope = (up - down) / (2 * step)
        assert np.abs(change - slope).max() < 1e-5 * np.abs(slope).max()


@pytest.mark.parametrize("light", [{}, {"illumination_na": 0.15}])
def test_a_simulated_particle_is_drawn_with_the_optics_of_its_place(light: dict[str, Any]) -> None:
    config = _config(
        "simulation.shape=[41, 41]", "simulation.frames=2", 'simulation.background="flat"',
        "simulation.power_noise=0", "simulation.photons_per_pixel=1000",
        "simulation.events=[{frame=1,x_px=35.0,y_px=20.0,mass_kda=480.0,z_nm=5.0}]",
        "background.frames=[0,1]", focus_tilt_nm="[100, 0]", focus_nm=-300, **light,
    )  # fmt: skip
    before, after = Movie(config, 1).expected_frames()
    grid = PixelGrid.region((0, 41), (0, 41), PIXEL_NM)
    there = _config(focus_nm=-300 + 100 * 15 / 20.5, **light)
    place = (35 * PIXEL_NM, 20 * PIXEL_NM, 5.0, 480.0)
    expected = forward_model(there, 6000.0).image(grid, *place)
    assert np.abs(after / before - 1 - expected).max() < 0.003 * np.abs(expected).max()
    even = forward_model(_config(focus_nm=-300, **light), 6000.0).image(grid, *place)
    assert np.abs(even - expected).max() > 0.05 * np.abs(expected).max()


def _landing(*settings: str) -> AnalysisContext:
    config = load_config(ROOT / "sample_configs" / "landing.toml", settings)
    return make_context(config, (260, 260), searches=10, sliding=True)


def test_models_of_places_share_the_table_of_the_middle() -> None:
    """It is nearly all that a model takes to make; optics with coma have none."""
    context = _landing("optics.focus_curvature_nm=100", "optics.focus_tilt_nm=[60, -40]")
    assert context.local is not None
    for models in context.local:
        seen = [models.at(x, 3000.0) for x in np.linspace(500, 21_500, 30)]
        assert len({each.optics.focus_nm for each in seen}) > 20
        assert len({id(each.wave.table) for each in seen}) <= 2  # with more focus, more nodes


@pytest.mark.parametrize("coma", [0, 20])
def test_a_model_for_what_is_near_shows_the_same_there(coma: float) -> None:
    context = _landing("optics.focus_tilt_nm=[60, -40]", f"optics.coma_field_nm={coma}")
    x, y, side = 150.3 * context.pixel_nm, 90.8 * context.pixel_nm, context.roi_px
    grid = PixelGrid.region((91 - side, 92 + side), (150 - side, 151 + side), context.pixel_nm)
    near, wide = (
        context.wide_at(x, y, reach_px=reach).image(grid, x, y, 5.0, 480.0)
        for reach in (side, side + 1)
    )
    peak = np.abs(wide).max()
    assert np.abs(near - wide).max() < 1e-5 * peak
    elsewhere = context.wide_at(10.0, 10.0).image(grid, x, y, 5.0, 480.0)
    assert np.abs(elsewhere - wide).max() > 0.01 * peak
