"""Errors of measured optics, which all events share, against fits with optics that are off."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from calibrations import GRID, PIXEL_NM, configuration
from shared_errors import systematic

from iscat_analysis.bounds import joint_information
from iscat_analysis.config import (
    Calibration,
    Config,
    Optics,
    OpticsCovariance,
    Uncertainty,
    config_to_toml,
    configure,
)
from iscat_analysis.errors import ConfigError
from iscat_analysis.inference.counts import conditional, counts_likelihood
from iscat_analysis.inference.laws import CONDITIONAL
from iscat_analysis.instrument.joint_fit import Estimate, maximise
from iscat_analysis.instrument.particle_image import ParticleImage, build_microscope
from iscat_analysis.optics.forward import PixelGrid, forward_model
from iscat_analysis.optics.parameters import FREE, PRIMARY, free_names, prior_of, settings_of
from iscat_analysis.records import EVENT_COLUMNS, FREE_PARAMETERS, PARAMETERS, Box, FloatArray
from iscat_analysis.trust.response import Response, response_of
from iscat_analysis.trust.systematic import contributions

NAMES = ("focus_nm", "na", "z8", "z11")
SIGMA = np.array([3.0, 0.003, 1.0, 1.0])
CORRELATION = np.array([[1, 0.5, 0, -0.9], [0.5, 1, 0, -0.4], [0, 0, 1, 0], [-0.9, -0.4, 0, 1.0]])
COVARIANCE = CORRELATION * np.outer(SIGMA, SIGMA)
LIGHT = 1e8
DIM, HEAVY_KDA, ROI_NM = 4e5, 2000.0, 28 * PIXEL_NM
LINE = Calibration(
    gradient_per_kda=-3.1e-5, offset=-2e-4, optics=Optics(focus_nm=-280.0), height_nm=5.0
)
"""Of standards whose optics are known without error."""

SURE = {f"uncertainty.{key}": 0.0 for key in Uncertainty.model_fields if key != "optics"}


def _config(covariance: np.ndarray[Any, Any] = COVARIANCE, **settings: Any) -> Config:
    errors = {"names": NAMES, "matrix": covariance.tolist()}
    base = {
        "optics.focus_nm": -300.0,
        "optics.covariance": errors,
        "camera.pixel_size_nm": 100.0,
        "fit.roi_nm": 1500.0,
        "particle.mass_kda": 480.0,
        "background.frames": (0, 200),
    }
    return configure(settings=base | SURE | settings)


def _fitted(
    config: Config, truth: Config, z_nm: float, amplitude: float, mode: str
) -> dict[str, float]:
    """Fit the picture that one microscope makes, without noise, with another."""
    grid = PixelGrid.centred(round(config.fit.roi_nm / 100), 100.0)
    signal = forward_model(truth, 2000.0).amplitude_image(grid, 0, 0, z_nm, amplitude)
    model = forward_model(config, 2000.0)
    light = np.full(grid.shape, LIGHT)
    likelihood = counts_likelihood(
        model, grid, light, light * (1 + signal), 1.0, background=1.0, noise=CONDITIONAL
    )
    start = np.array([0.0, 0.0, z_nm, amplitude, 0.0])
    width = np.array([150.0, 150.0, 60.0, 0.5 * abs(amplitude), 0.0])
    free = np.array([name in FREE_PARAMETERS[mode] for name in PARAMETERS] + [False])
    width = np.where(free, width, 0.0)
    found = likelihood.maximize(
        start, Box(free, start - width, start + width), tolerance=1e-9
    ).theta
    mass = float(model.scale.mass(np.asarray(found[3])))
    places = dict(zip(PARAMETERS, (*map(float, found[:3]), mass), strict=True))
    return places | {"contrast": model.amplitude_contrast(float(found[2]), float(found[3]))}


def _event(config: Config, z_nm: float, amplitude: float) -> pd.DataFrame:
    model = forward_model(config, 2000.0)
    mass = float(model.scale.mass(np.asarray(amplitude)))
    row = dict.fromkeys(EVENT_COLUMNS, 0.0)
    values = {"z_nm": z_nm, "mass_kda": mass, "n_before": 200, "n_after": 200, "status": "ok"}
    values["contrast"] = model.amplitude_contrast(z_nm, amplitude)
    return pd.DataFrame([row | values])


def _moved(config: Config, shifts: np.ndarray[Any, Any], names: tuple[str, ...] = NAMES) -> Config:
    settings = settings_of(config)
    for name, shift in zip(names, shifts, strict=True):
        settings[name] = settings[name] + float(shift)
    terms = {k: v for k, v in settings.items() if k[0] == "z" and k[1:].isdigit() and v}
    changed = {k: settings[k] for k in ("focus_nm", "na")} | {"aberrations_nm": terms}
    return config.model_copy(update={"optics": config.optics.model_copy(update=changed)})


@pytest.mark.parametrize("mode", ["mass", "joint"])
@pytest.mark.parametrize("line", [None, LINE])
def test_a_small_error_of_one_parameter_moves_the_fit_as_predicted(
    mode: str, line: Calibration | None
) -> None:
    z_nm, amplitude, step = 100.0, 400.0, 2e-2
    plain = _config(**{"fit.mode": mode}).model_copy(update={"calibration": line})
    for k, name in enumerate(NAMES):
        single = np.zeros((4, 4))
        single[k, k] = (step * SIGMA[k]) ** 2
        config = _config(single, **{"fit.mode": mode}).model_copy(update={"calibration": line})
        predicted = systematic(config, _event(config, z_nm, amplitude))
        shift = step * SIGMA * np.eye(4)[k]
        up, down = (
            _fitted(_moved(plain, s * shift), plain, z_nm, amplitude, mode) for s in (1, -1)
        )
        assert set(predicted) == {*FREE_PARAMETERS[mode], *(["contrast"] if line is None else [])}
        for parameter in predicted:
            moved = abs(up[parameter] - down[parameter]) / 2
            floor = 1e-6 * {"mass_kda": amplitude, "contrast": 1e-2}.get(parameter, 1.0)
            assert predicted[parameter][0] == pytest.approx(moved, rel=5e-3, abs=floor), (
                name,
                parameter,
            )


def test_the_column_is_the_spread_over_draws_of_the_optics() -> None:
    """80 draws tell a standard deviation to 8 %."""
    config, draws = _config(), 80
    rng = np.random.default_rng(11)
    shifts = rng.multivariate_normal(np.zeros(4), COVARIANCE, draws)
    fits = pd.DataFrame([_fitted(_moved(config, s), config, 5.0, 480.0, "mass") for s in shifts])
    event = _event(config, 5.0, 480.0)
    column = systematic(config, event)
    uncorrelated = systematic(_config(np.diag(np.diag(COVARIANCE))), event)
    pulls = {
        name: (fits[name].std() / column[name][0] - 1) * np.sqrt(2 * draws)
        for name in ("x_nm", "mass_kda")
    }
    assert max(map(abs, pulls.values())) < 3.5, pulls
    wrong = (fits["mass_kda"].std() / uncorrelated["mass_kda"][0] - 1) * np.sqrt(2 * draws)
    assert abs(wrong) > 5  # the correlations matter, and the test sees it


def test_a_line_from_the_same_optics_takes_the_common_factor_away() -> None:
    """Standards and sample through the same wrong microscope: only bright particles differ."""
    standard, light, bright = 10.0, 480.0, 3e5
    line = Calibration(gradient_per_kda=-0.01, optics=_config().optics, height_nm=5.0)

    def masses(config: Config) -> np.ndarray[Any, Any]:
        contrasts = [
            _fitted(config, _config(), 5.0, a, "mass")["mass_kda"] * -0.01
            for a in (standard, light, bright)
        ]
        return np.array(contrasts[1:]) / contrasts[0]

    config = _config().model_copy(update={"calibration": line})
    shifts = 0.03 * np.sqrt(np.diag(COVARIANCE)) * np.array([1, 0, 0, 0])
    up, down = (masses(_moved(config, s * shifts)) for s in (1, -1))
    remains = np.abs(np.log(up / down)) / 2
    single = _config(np.diag(shifts**2))
    theirs = OpticsCovariance(names=NAMES, matrix=tuple(map(tuple, np.diag(4 * shifts**2))))
    for covariance, shared in ((single.optics.covariance, True), (theirs, False)):
        known = line.model_copy(update={"covariance": covariance})
        same = single.model_copy(update={"calibration": known})
        for amplitude, left in zip((light, bright), remains, strict=True):
            event = _event(same, 5.0, amplitude)
            share = systematic(same, event)["mass_kda"][0] / abs(event["mass_kda"][0])
            if shared:
                assert share == pytest.approx(left, rel=0.05, abs=2e-7)
            else:  # standards learned alone, with errors of their own that are twice as large
                assert share > 1e-5
    assert remains[1] > 5 * remains[0]


def test_many_events_share_what_is_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A few amplitudes at ten heights of every fringe serve any number of events."""
    config = _config(**{"fit.mode": "joint", "fit.roi_nm": 3000.0, "camera.pixel_size_nm": 84.4})
    rng = np.random.default_rng(3)
    table = pd.concat([_event(config, 5.0, 480.0)] * 1000, ignore_index=True)
    table["z_nm"] = rng.uniform(0, 1000, 1000)
    table["mass_kda"] = rng.uniform(100, 1000, 1000)
    computed: list[float] = []

    def counted(likelihood: Any, theta: Any, names: Any) -> Any:
        computed.append(theta[2])
        return joint_information(likelihood, theta, names)

    monkeypatch.setattr("iscat_analysis.trust.response.joint_information", counted)
    found = systematic(config, table)
    fringes = 1000.0 / forward_model(config, 2000.0).fringe_nm
    assert len(set(computed)) <= 10 * fringes + 2
    assert len(computed) == 4 * len(set(computed))
    for index in range(5):
        alone = systematic(config, table[index : index + 1])
        for name in PARAMETERS:
            room = 0.01 * float(np.max(found[name]))
            assert found[name][index] == pytest.approx(alone[name][0], rel=0.05, abs=room + 1e-9)


def test_what_is_not_known_has_no_column() -> None:
    table = _event(_config(), 5.0, 480.0)
    for settings in (
        {"optics.covariance": None},
        {"optics.scheme": "darkfield"},
        {"optics.convention": "dong2021"},
    ):
        assert systematic(_config(**settings), table) == {}
    empty = systematic(_config(), table[:0])
    assert set(empty) == {"x_nm", "y_nm", "mass_kda", "contrast"}


def test_the_covariance_survives_the_way_through_a_file() -> None:
    config = _config()
    again = configure(tomllib.loads(config_to_toml(config)))
    assert again.optics.covariance == config.optics.covariance
    with pytest.raises(ConfigError, match="names has focus, which is none of"):
        _config(**{"optics.covariance": {"names": ["focus"], "matrix": [[1.0]]}})
    with pytest.raises(ConfigError, match="not symmetric"):
        _config(np.triu(COVARIANCE))


def _learned(count: int, sizes: float) -> tuple[Estimate, Response, FloatArray]:
    """Learn the optics from noiseless images whose pixels are larger by a share; predict that."""
    config = configure(
        configuration(), settings={"background.method": "sliding", "fit.roi_nm": ROI_NM}
    )
    settings, reach = settings_of(config), 2600.0
    model = build_microscope(config, reach, settings)
    larger = PixelGrid(*((1 + sizes) * axis for axis in (GRID.x_nm, GRID.y_nm)), GRID.pixel_nm)
    before = np.full(GRID.shape, DIM)
    images = []
    for mass in [HEAVY_KDA] * count:
        after = DIM * (1 + model.image(larger, 0.0, 0.0, 5.0, mass))
        data = conditional(model, GRID, before, after, 1.0).data
        images.append(ParticleImage(GRID, CONDITIONAL, data, 0.0, 0.0, 5.0, mass_kda=mass))
    names = free_names(tuple(FREE), settings, PRIMARY)
    found = maximise(
        images, lambda some: build_microscope(config, reach, some), settings, names,
        prior=prior_of(config), tolerance=1e-9,
    )  # fmt: skip
    errors = OpticsCovariance(names=names, matrix=tuple(map(tuple, found.bound.tolist())))
    optics = config.optics.model_copy(update={"covariance": errors})
    rows = pd.DataFrame({"n_before": [100], "n_after": [100]})
    respond = response_of(config.model_copy(update={"optics": optics}), rows)
    amplitude = float(model.scale.amplitudes(HEAVY_KDA))
    change = (
        model.amplitude_image(larger, 0.0, 0.0, 5.0, amplitude)
        - model.amplitude_image(GRID, 0.0, 0.0, 5.0, amplitude)
    ) / sizes
    return found, respond, change


@pytest.mark.parametrize("count", [1, 8])
def test_learned_optics_follow_a_wrong_input_as_far_as_the_prior_lets_them(count: int) -> None:
    """Control: without the prior, amplitudes move by half as much again, or twice as much."""
    sizes = 1e-3
    found, respond, change = _learned(count, sizes)
    amplitude = float(respond.model.scale.amplitudes(HEAVY_KDA))
    middle = settings_of(configuration())
    moved = np.array([found.values[name] - middle[name] for name in found.names]) / sizes
    shift = (found.images[0].mass_kda / HEAVY_KDA - 1) / sizes
    said = respond.to_input(change, amplitude)
    np.testing.assert_allclose(
        said.optics / found.errors, moved / found.errors, rtol=0.01, atol=0.1
    )
    assert said.amplitude == pytest.approx(shift, rel=0.02)
    without = replace(respond, posterior=np.zeros_like(respond.posterior))
    assert without.to_input(change, amplitude).amplitude / shift > 1.3


def test_a_doubt_about_the_field_grows_from_its_centre() -> None:
    """A curved focus is another focus at (x² + y²) of the distance to the centre."""
    config = _config(**{"optics.covariance": None})
    table = _event(config, 5.0, 0.06).assign(x_px=72.0, y_px=48.0)

    def error(name: str, sigma: float) -> float:
        tested = {"names": [name], "covariance": [[sigma**2]], "field_px": [48.0, 48.0, 48.0]}
        for learned in (True, False):
            found = contributions(config, table, {"optics": tested | {"calibrated": learned}})
            assert bool(found) != learned
        return float({s.name: e for s, e in found}["optics as configured"]["mass_kda"][0])

    assert error("focus_curvature_nm", 8.0) == pytest.approx(error("focus_nm", 8.0 * 0.5**2))
