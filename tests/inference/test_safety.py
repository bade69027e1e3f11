"""What must not reach a kernel: places outside the model, arrays of the wrong kind or shape."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scenes import PIXEL_NM, make_config

from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.inference import counts as noise
from iscat_analysis.inference.fit import fit_particle
from iscat_analysis.inference.laws import POISSON
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.optics.forward import ForwardModel, PixelGrid, forward_model
from iscat_analysis.records import Box, Candidate

GRID = PixelGrid.region((0, 15), (0, 17), PIXEL_NM)
CENTRE = (8.2 * PIXEL_NM, 6.7 * PIXEL_NM)
RANGE_NM = (0.0, 1000.0)
LIGHT = 1e6


@pytest.fixture(scope="module")
def model() -> ForwardModel:
    return forward_model(make_config(fit={"z_range_nm": list(RANGE_NM)}), 2500.0)


@pytest.fixture(scope="module")
def theta(model: ForwardModel) -> np.ndarray:
    return np.array([*CENTRE, 60.0, model.scale.amplitude(1000.0), 0.0])


@pytest.fixture(scope="module", params=["conditional", "poisson"])
def which(request: pytest.FixtureRequest, model: ForwardModel, theta: np.ndarray) -> Likelihood:
    rng = np.random.default_rng(1)
    after = rng.poisson(LIGHT * (1 + model.amplitude_image(GRID, *theta[:4]))).astype(float)
    if request.param == "poisson":
        return noise.poisson(model, GRID, after, LIGHT, LIGHT)
    before = rng.poisson(LIGHT, GRID.shape).astype(float)
    return noise.conditional(model, GRID, before, after, 1.0)


# ---- outside the support -----------------------------------------------------------------------

OUTSIDE = [
    (0, 1e6), (0, -1e6), (1, 1e6), (0, 1e300), (0, math.nan), (1, math.inf),
    (2, -1.0), (2, 1001.0), (2, 1e6), (2, math.nan),
    (3, math.nan), (3, math.inf), (4, 1e3), (4, math.nan),
]  # fmt: skip


@pytest.mark.parametrize(("index", "value"), OUTSIDE)
def test_outside_the_support_nothing_is_likely(
    index: int, value: float, which: Likelihood, theta: np.ndarray
) -> None:
    """An index beyond the radial table ends the interpreter; a height beyond it means nothing."""
    point = theta.copy()
    point[index] = value
    values = which.values(np.stack([theta, point, theta]))
    assert values[1] == -math.inf
    assert values[0] == values[2] == which.values(theta[None])[0]
    told, score, fisher = which.score_fisher(point)
    assert told == -math.inf
    assert np.isnan(score).all()
    assert np.isnan(fisher).all()
    for refused in (which.signal, which.residuals):
        with pytest.raises(ConfigError, match="the model is known for z_nm from 0 to 1000"):
            refused(point)


def test_amplitudes_that_overflow_are_impossible(which: Likelihood, theta: np.ndarray) -> None:
    point = theta.copy()
    point[3] = 1e200
    assert which.values(point[None])[0] == -math.inf


def test_the_support_ends_where_the_table_does(which: Likelihood, theta: np.ndarray) -> None:
    """Up to the last nanometre values are those of the pupil sum."""
    far = which.model.reach_nm
    half = PIXEL_NM / 2
    y = theta[1]
    away = max(abs(y - GRID.y_nm[0]), abs(y - GRID.y_nm[-1])) + half
    edge = math.sqrt(far**2 - away**2) - half
    for shift, known in ((-1.0, True), (1.0, False)):
        point = theta.copy()
        point[0] = edge + shift
        assert bool(np.isfinite(which.values(point[None])[0])) is known
    point[0] = edge - 1.0
    assert which.values(point[None])[0] == pytest.approx(which.score_fisher(point)[0], abs=1e-4)


def test_heights_outside_the_model_are_not_scanned(which: Likelihood, theta: np.ndarray) -> None:
    heights = np.array([-50.0, 0.0, 60.0, 1000.0, 1e5, math.nan])
    values, amplitudes = which.scan_heights(heights, theta, (-1e5, 1e5))
    assert np.isfinite(values).tolist() == [False, True, True, True, False, False]
    assert np.isnan(amplitudes).tolist() == [True, False, False, False, True, True]
    values, _ = which.scan_heights(heights, np.array([1e6, *theta[1:]]), None)
    assert (values == -math.inf).all()


ALL = np.array([True, True, True, True, False])


@pytest.mark.parametrize(
    ("lower", "upper"),
    [((-1e6, 0, 0), (1e6, 100, 500)), ((0, 0, -10), (900, 900, 500)), ((0, 0, 0), (900, 900, 2e3))],
)
def test_a_box_that_leaves_the_support_is_refused(
    lower: tuple[float, ...], upper: tuple[float, ...], which: Likelihood, theta: np.ndarray
) -> None:
    low, high = np.array([*lower, 0.0, 0.0]), np.array([*upper, 1e5, 0.0])
    start = np.clip(theta, low, high)
    with pytest.raises(ConfigError, match="narrow the box"):
        which.maximize(start, Box(ALL, low, high))


def test_a_start_outside_its_box_is_refused(which: Likelihood, theta: np.ndarray) -> None:
    margin = np.array([100.0, 100.0, 50.0, theta[3], 0.0])
    start = theta + np.array([200.0, 0.0, 0.0, 0.0, 0.0])
    with pytest.raises(ConfigError, match="outside the box"):
        which.maximize(start, Box(ALL, theta - margin, theta + margin))
    start[0] = math.nan
    with pytest.raises(ConfigError, match="outside the box"):
        which.maximize(start, Box(ALL, theta - margin, theta + margin))


def test_a_box_without_end_for_the_amplitude_is_safe(which: Likelihood, theta: np.ndarray) -> None:
    margin = np.array([100.0, 100.0, 50.0, math.inf, 0.0])
    start = theta.copy()
    start[3] = 1e160  # its square overflows
    found = which.maximize(start, Box(ALL, theta - margin, theta + margin))
    assert not found.converged


# ---- arrays of another kind or shape -----------------------------------------------------------


@pytest.mark.parametrize(
    "thetas", [np.zeros(5), np.zeros((3, 4)), np.zeros((1, 1, 5)), [["x"] * 5], [[1, 2], [3]]]
)
def test_parameters_of_another_shape_are_refused(thetas: object, which: Likelihood) -> None:
    with pytest.raises(DataError, match="thetas"):
        which.values(thetas)  # type: ignore[arg-type]


def test_a_single_theta_of_another_shape_is_refused(which: Likelihood, theta: np.ndarray) -> None:
    for call in (which.score_fisher, which.signal, which.residuals):
        with pytest.raises(DataError, match="theta: has shape"):
            call(theta[:4])
    with pytest.raises(DataError, match="start: has shape"):
        which.maximize(theta[:4], Box(ALL, theta, theta))
    with pytest.raises(DataError, match="free: has shape"):
        which.maximize(theta, Box(ALL[:4], theta, theta))


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.int16, np.int32, np.uint64, np.float32])
def test_counts_of_any_type_mean_the_same(kind: type, model: ForwardModel) -> None:
    """Sums of integers wrap: 40000 + 40000 is 14464 in 16 bits."""
    most = 40_000 if kind != np.int16 else 30_000
    most = most if kind != np.uint8 else 200
    rng = np.random.default_rng(2)
    before, after = rng.poisson(0.95 * most, (2, *GRID.shape)).clip(1, most).astype(kind)
    exact = before.astype(float), after.astype(float)
    for make in (
        lambda b, a: noise.conditional(model, GRID, b, a, 1),
        lambda b, a: noise.poisson(model, GRID, a, b, b),
    ):
        np.testing.assert_array_equal(make(before, after).data, make(*exact).data)


COUNTS = np.full(GRID.shape, 100.0)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"before_e": COUNTS.T}, "before_e: has shape"),
        ({"after_e": COUNTS[:, :-1]}, "after_e: has shape"),
        ({"after_e": 100.0}, "after_e: has shape"),
        ({"before_e": COUNTS.astype(complex)}, "before_e: holds complex128"),
        ({"before_e": COUNTS.astype(str)}, "before_e: holds"),
        ({"after_e": np.where(np.eye(15, 17, dtype=bool), np.nan, COUNTS)}, "15 pixels; mask them"),
        ({"power_ratio": np.ones(3)}, "power_ratio: has shape"),
        ({"power_ratio": -1.0}, "power_ratio = -1: give"),
        ({"power_ratio": math.nan}, "power_ratio: is not finite"),
        ({"read_variances_e2": (0.0, -4.0)}, "read_variance_after_e2 = -4: must be at least 0"),
        ({"masked": COUNTS}, "masked: holds float64"),
        ({"masked": np.zeros((2, 2), dtype=bool)}, "masked: has shape"),
    ],
)
def test_bad_arrays_are_named(changed: dict, message: str, model: ForwardModel) -> None:
    given = {"before_e": COUNTS, "after_e": COUNTS, "power_ratio": 1.0, **changed}
    with pytest.raises(DataError, match=message):
        noise.conditional(model, GRID, **given)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"counts_e": COUNTS[0]}, "counts_e: has shape"),
        ({"background_e": np.inf}, "background_e: is not finite"),
        ({"scale_e": 0.0}, "scale_e = 0: give"),
        ({"extra_variance_e2": "1"}, "extra_variance_e2: holds"),
    ],
)
def test_bad_arrays_of_a_known_background_are_named(
    changed: dict, message: str, model: ForwardModel
) -> None:
    given = {"counts_e": COUNTS, "background_e": 100.0, "scale_e": 100.0, **changed}
    with pytest.raises(DataError, match=message):
        noise.poisson(model, GRID, **given)


def test_a_pixel_that_is_no_number_may_be_masked(model: ForwardModel, theta: np.ndarray) -> None:
    dead = np.eye(15, 17, dtype=bool)
    after = np.where(dead, np.nan, 100.0)
    for which in (
        noise.conditional(model, GRID, COUNTS, after, 1.0, masked=dead),
        noise.poisson(model, GRID, after, 100.0, 100.0, masked=dead),
    ):
        assert which.n_pixels == dead.size - dead.sum()
        assert np.isfinite(which.values(theta[None])).all()


@pytest.mark.parametrize(
    "data",
    [np.zeros((3, 15, 17)), np.zeros((4, 15, 17), dtype=int), np.full((4, 15, 17), np.nan), None],
)
def test_constants_of_another_kind_are_refused(data: object, model: ForwardModel) -> None:
    with pytest.raises(DataError, match="data"):
        Likelihood(model, GRID, POISSON, data)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("x", "pixel", "message"),
    [
        ([], 10.0, "x_nm"), ([[0.0, 1.0]], 10.0, "x_nm"), ([0.0, np.nan], 10.0, "x_nm"),
        ([1.0, 0.0], 10.0, "ascend"), ([0.0, 1.0], 0.0, "pixel_nm = 0"),
    ],
)  # fmt: skip
def test_grids_that_are_none_are_refused(x: list, pixel: float, message: str) -> None:
    with pytest.raises(DataError, match=message):
        PixelGrid(np.array(x), np.arange(3.0), pixel)


# ---- below the offset of a calibration ---------------------------------------------------------


@pytest.mark.parametrize("offset", [-1e-3, 1e-3])
def test_residuals_judge_the_image_that_was_fitted(offset: float) -> None:
    """A contrast below the offset has no mass; through it the image would be another one."""
    line = {"gradient_per_kda": -3.1e-5, "offset": offset}
    calibrated = forward_model(make_config(calibration=line), 2500.0)
    bare = forward_model(make_config(calibrated=False), 2500.0)
    amplitude = calibrated.scale.amplitude(1000.0) * 0.6e-3 / 3.1e-2
    theta = np.array([*CENTRE, 5.0, amplitude, 0.0])
    truth = bare.image(GRID, *theta[:4])
    assert 0 < np.abs(truth).max() < abs(offset)
    which = noise.poisson(calibrated, GRID, LIGHT * (1 + truth), LIGHT, LIGHT)
    np.testing.assert_allclose(which.signal(theta), truth, rtol=0, atol=1e-12)
    np.testing.assert_allclose(which.residuals(theta), 0, atol=1e-6)
    start = Candidate(CENTRE[0] / PIXEL_NM, CENTRE[1] / PIXEL_NM, 5.0, 1000.0, 5.0)
    fit = fit_particle(which, start, "mass", RANGE_NM, level=False, correct_bias=False)
    assert fit.contrast == pytest.approx(bare.peak_contrast(5.0, amplitude), rel=1e-4)
