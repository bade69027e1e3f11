"""Each fast way of a fit against a slow one that is obviously right."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scenes import PIXEL_NM, gold, make_config, observed_information

from iscat_analysis._kernels.hessian import PAIRS, first_order_bias
from iscat_analysis._kernels.image import signal_gradient, signal_image
from iscat_analysis._kernels.scoring import image_score, picture_at, score_pass
from iscat_analysis.config import Calibration
from iscat_analysis.inference import counts as noise
from iscat_analysis.inference.fit import (
    FOLLOWED,
    ORDER,
    PLAIN,
    WAIST,
    fit_particle,
    gamma_above,
    precision,
    search_box,
    start_theta,
    three_tests,
)
from iscat_analysis.inference.laws import CONDITIONAL
from iscat_analysis.inference.likelihood import LEVEL, Likelihood
from iscat_analysis.inference.maximiser import Optimum
from iscat_analysis.optics.forward import ForwardModel, PixelGrid, forward_model
from iscat_analysis.records import PARAMETERS, BoolArray, Box, Candidate, FitResult, FloatArray

GRID = PixelGrid.region((0, 14), (0, 13), PIXEL_NM)
SETTLED = 0.02  # σ: how far apart two fits of one optimum may end
FREE = [(True, True, True, True, True), (True, True, False, True, False)]


@dataclass(frozen=True)
class Case:
    """A region and a place in it."""

    likelihood: Likelihood
    theta: FloatArray

    @property
    def model(self) -> ForwardModel:
        return self.likelihood.model


def _case(kind: str, *, light: float = 3e3, pupil: str = "round", seed: int = 4) -> Case:
    sections = gold() if pupil == "gold" else {"optics": {"focus_nm": -400.0}}
    if pupil == "coma":
        sections["optics"]["aberrations_nm"] = {"z7": 15.0}
    if pupil == "dark":
        sections["optics"]["scheme"] = "darkfield"
    config = make_config(calibrated=False, fit={"z_range_nm": [0.0, 600.0]}, **sections)
    model = forward_model(config, 2200.0)
    theta = np.array([520.0, 610.0, 90.0, 2 * model.material.mass_kda, 0.02])
    rng = np.random.default_rng(seed)
    signal, masked = model.amplitude_image(GRID, *theta[:4]), rng.random(GRID.shape) < 0.1
    if kind == "conditional":
        before, after = rng.poisson(light, GRID.shape), rng.poisson(1.02 * light * (1 + signal))
        likelihood = noise.conditional(
            model, GRID, before, after, 1.0, read_variances_e2=(0.0, 50.0), masked=masked
        )
    else:
        scale = light if model.rho else 30 / signal.max()
        after = rng.poisson(light + scale * signal)
        likelihood = noise.poisson(
            model, GRID, after, light, scale, extra_variance_e2=20.0, masked=masked
        )
    return Case(likelihood, theta)


CASES = [
    ("conditional", "round"), ("conditional", "gold"), ("conditional", "coma"),
    ("poisson", "round"), ("poisson", "dark"),
]  # fmt: skip


@pytest.fixture(scope="module", params=CASES, ids=lambda case: "-".join(case))
def case(request: pytest.FixtureRequest) -> Case:
    kind, pupil = request.param
    return _case(kind, pupil=pupil)


# ---- derivatives and what is made of them --------------------------------------------------------


def test_derivatives_between_heights_and_at_a_fixed_one(case: Case) -> None:
    exact = np.moveaxis(case.likelihood.derivatives(case.theta), 1, 0)
    size = np.abs(exact).max(axis=(1, 2), keepdims=True)
    free = np.array(FREE[0])
    between = np.moveaxis(case.likelihood.derivatives(case.theta, free), 1, 0)
    np.testing.assert_allclose(between / size, exact / size, atol=1e-6)
    fixed = np.moveaxis(case.likelihood.derivatives(case.theta, np.array(FREE[1])), 1, 0)
    known = [0, 1, 2, 4, *(5 + k for k, pair in enumerate(PAIRS) if 2 not in pair)]
    np.testing.assert_allclose((fixed / size)[known], (exact / size)[known], atol=1e-12)


def _bias(which: Likelihood, theta: FloatArray, free: BoolArray) -> FloatArray:
    """Give the bias by tensors over the pixels, as the papers write it."""
    signal, first, second = which.model.amplitude_hessian(GRID, *theta[:4])
    _, c1, c2, c3 = which.data
    level = math.exp(theta[LEVEL])
    gradient, bend = np.zeros((5, *GRID.shape)), np.zeros((5, 5, *GRID.shape))
    if which.noise == CONDITIONAL:
        odds = c2 * level * (1 + signal)
        variance = c3 * c1 * odds / (1 + odds) ** 2
        skewness = variance * (1 - odds) / (1 + odds)
        gradient[:4], gradient[LEVEL] = first / (1 + signal), 1.0
        bend[:4, :4] = second / (1 + signal) - gradient[:4, None] * gradient[None, :4]
    else:
        light = level * (c1 + c2 * signal)
        rate = np.where(which.used, light + c3, 1.0)
        variance = skewness = np.where(which.used, rate, 0.0)
        gradient[:4], gradient[LEVEL] = level * c2 / rate * first, light / rate
        bend[:4, :4] = level * c2 / rate * second
        bend[LEVEL, :4] = bend[:4, LEVEL] = gradient[:4]
        bend[LEVEL, LEVEL] = gradient[LEVEL]
        bend -= gradient[:, None] * gradient[None]
    index = np.flatnonzero(free)
    slope, bend = gradient[index], bend[np.ix_(index, index)]
    unit = 1 / np.sqrt(np.einsum("iyx,yx->i", slope**2, variance))
    fisher = np.einsum("iyx,jyx,yx->ij", slope, slope, variance)
    inverse = np.linalg.inv(fisher * np.outer(unit, unit)) * np.outer(unit, unit)
    curved = np.einsum("ij,ijyx->yx", inverse, bend)
    skewed = np.einsum("ij,iyx,jyx->yx", inverse, slope, slope)
    out = np.zeros(5)
    pull = np.einsum("iyx,yx->i", slope, skewness * skewed + variance * curved)
    out[index] = -0.5 * inverse @ pull
    return out


@pytest.mark.parametrize("free", FREE)
def test_bias(case: Case, free: tuple[bool, ...]) -> None:
    which, free_array = case.likelihood, np.array(free)
    derivatives = which.derivatives(case.theta)
    level = math.exp(case.theta[LEVEL])
    got = first_order_bias(which.measured, level, derivatives, free_array)
    slow = _bias(which, case.theta, free_array)
    scale = 1 / np.sqrt(np.diag(which.score_fisher(case.theta)[2]))
    np.testing.assert_allclose(got / scale, slow / scale, atol=1e-9)
    assert np.abs(slow / scale).max() > 1e-5
    nowhere = case.theta * np.array([1, 1, 1, 0, 1])
    none = which.derivatives(nowhere)
    lost = first_order_bias(which.measured, level, none, free_array)
    assert np.isnan(lost).any() or not case.model.rho


@pytest.mark.parametrize("free", FREE)
def test_errors_are_those_of_the_observed_information(case: Case, free: tuple[bool, ...]) -> None:
    theta, free_array, slope = case.theta * [1, 1, 1, 1, 0], np.array(free), 1.7
    which = noise.asimov_conditional(case.model, GRID, theta, 1e4, 200, 200)
    fisher = which.score_fisher(theta)[2]
    derivatives = which.derivatives(theta)
    known, sigma, covariance, bias = precision(
        which, theta, fisher, free_array, derivatives, slope=slope
    )
    assert known
    observed = observed_information(which, theta)[np.ix_(free_array, free_array)]
    unit = np.array([1, 1, 1, slope])[free_array[:4]]
    dense = np.linalg.inv(observed)[: unit.size, : unit.size] * np.outer(unit, unit)
    errors = np.sqrt(dense.diagonal())
    size = np.outer(errors, errors)
    np.testing.assert_allclose(covariance / size, dense / size, atol=1e-8)
    np.testing.assert_allclose(sigma[free_array[:4]], errors, rtol=1e-8)
    assert np.isnan(sigma[~free_array[:4]]).all()
    walls = np.arange(5) == 1
    *_, without = precision(which, theta, fisher, free_array, derivatives, walls=walls)
    assert without[1] == 0.0 != bias[1]
    poor = replace(which, data=which.data * np.array([0.0, 1.0, 1.0, 1.0])[:, None, None])
    nothing, *lost = precision(poor, theta, fisher, free_array, derivatives)
    assert not nothing
    assert all(np.isnan(one).all() for one in lost)


# ---- the score test ------------------------------------------------------------------------------


def _structure(which: Likelihood, theta: FloatArray, free: BoolArray) -> float:
    """Give the p-value by Gram–Schmidt on vectors over the pixels."""
    signal, gradient = which.model.signal(GRID, theta[:4])
    c0, c1, c2, c3 = (c[which.used] for c in which.data)
    level, s = math.exp(theta[LEVEL]), signal[which.used]
    if which.noise == CONDITIONAL:
        p = c2 * level * (1 + s) / (1 + c2 * level * (1 + s))
        weight = np.sqrt(c3 * c1 * p * (1 - p))
        residual, relative = (c0 - c1 * p) * c3 / weight, 1 / (1 + s)
        kurtosis = c3 * (1 / (c1 * p * (1 - p)) - 6 / c1)
    else:
        light = level * (c1 + c2 * s)
        rate = light + c3
        weight, residual = light / np.sqrt(rate), (c0 - rate) / np.sqrt(rate)
        relative, kurtosis = c2 * level / light, 1 / rate
    waist = WAIST * which.model.optics.wavelength_nm / which.model.optics.na
    along, across = (
        [
            np.polynomial.Hermite.basis(n)(t)
            * np.exp(-(t**2) / 2)
            / math.sqrt(2.0**n * math.factorial(n))
            for n in range(ORDER + 1)
        ]
        for t in ((GRID.x_nm - theta[0]) / waist, (GRID.y_nm - theta[1]) / waist)
    )
    fitted = [*(gradient[:, which.used] * relative), np.ones(s.size)]
    vectors = [v for v, is_free in zip(fitted, free, strict=True) if is_free]
    count = len(vectors)
    vectors += [
        np.outer(across[j], along[i])[which.used]
        for i, j in itertools.product(range(ORDER + 1), repeat=2)
        if i + j <= ORDER
    ]
    basis = np.linalg.qr((np.array(vectors) * weight).T)[0]
    modes = basis[:, count:].T
    leverage = np.sum(modes**2, axis=0)
    excess = float(kurtosis @ leverage**2) / len(modes)
    return gamma_above(float(np.sum((modes @ residual) ** 2)), len(modes), excess)


@pytest.mark.parametrize("free", FREE)
def test_structure(case: Case, free: tuple[bool, ...]) -> None:
    for moved in (0.0, 25.0):  # a place where it is good, and one where it is not
        theta = case.theta + np.array([moved, 0, 0, 0, 0])
        got = three_tests(case.likelihood, theta, np.array(free))[1][1]
        slow = _structure(case.likelihood, theta, np.array(free))
        assert math.log(got) == pytest.approx(math.log(slow), rel=1e-6, abs=1e-7)


def test_structure_of_many_counts() -> None:
    """Where no leverage matters, none is looked at."""
    many = _case("conditional", light=3e6)
    got = three_tests(many.likelihood, many.theta, np.array(FREE[0]))[1][1]
    slow = _structure(many.likelihood, many.theta, np.array(FREE[0]))
    assert got == pytest.approx(slow, rel=1e-5)


# ---- the search along z --------------------------------------------------------------------------


def test_scan_takes_two_steps_in_the_amplitude(case: Case) -> None:
    heights = np.array([0.0, 77.0, 90.0, 333.0, 600.0])
    start = case.theta * np.array([1, 1, 1, 0.7, 1])
    values, amplitudes = case.likelihood.scan_heights(heights, start, (0.0, 1e9))
    held, same = case.likelihood.scan_heights(heights, start, None)
    for k, z in enumerate(heights):
        theta = start.copy()
        theta[2] = z
        assert same[k] == start[3]
        unmoved = case.likelihood.values(theta[None])[0]
        assert held[k] == pytest.approx(unmoved, rel=1e-6, abs=1e-6)
        for _ in range(2):
            _, score, fisher = case.likelihood.score_fisher(theta)
            if fisher[3, 3] > 0:
                theta[3] = np.clip(theta[3] + score[3] / fisher[3, 3], 0.0, 1e9)
        assert amplitudes[k] == pytest.approx(theta[3], rel=1e-6, abs=1e-9)
        value = case.likelihood.values(theta[None])[0]
        assert values[k] == pytest.approx(value, rel=1e-6, abs=1e-6)


def _every_start(
    which: Likelihood, start: Candidate, z_range: tuple[float, float]
) -> list[Optimum]:
    """Follow a start at every height of a fine grid to its end; best first."""
    box = search_box(which, start_theta(which, start), "joint", z_range)
    found = []
    for z in np.arange(z_range[0], z_range[1], 15.0):
        theta = np.array([start.x_px * PIXEL_NM, start.y_px * PIXEL_NM, z, 1.0, 0.0])
        theta[3] = which.model.scale.amplitude(start.mass_kda)
        found.append(which.maximize(theta, box))
    return sorted((o for o in found if o.converged), key=lambda o: -o.log_likelihood)


@pytest.mark.parametrize("mass", [150.0, 1200.0])
@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(n, marks=pytest.mark.large) for n in (1, 2, 3))]
)
def test_starts_that_are_given_up_change_nothing(mass: float, seed: int) -> None:
    """The best optimum and all that come near it, as if every start had been followed."""
    model = forward_model(make_config(optics={"focus_nm": -500.0}), 2500.0)
    grid, rng = PixelGrid.region((0, 20), (0, 20), PIXEL_NM), np.random.default_rng(seed)
    signal = model.image(grid, 9.2 * PIXEL_NM, 10.1 * PIXEL_NM, rng.uniform(0, 600), mass)
    before, after = rng.poisson(2e6, grid.shape), rng.poisson(2e6 * (1 + signal))
    which = noise.conditional(model, grid, before, after, 1.0)
    start = Candidate(9.6, 9.8, 300.0, 1.5 * mass, 10.0)
    fit = fit_particle(which, start, "joint", (0.0, 600.0), level=False)
    slow = _every_start(which, start, (0.0, 600.0))
    sigma = np.append(fit.sigma, 1.0)
    assert np.all(np.abs(fit.theta - slow[0].theta)[:3] < SETTLED * sigma[:3])
    assert fit.log_likelihood == pytest.approx(slow[0].log_likelihood, abs=1e-3)
    near = {}
    for other in slow:
        gap, z = slow[0].log_likelihood - other.log_likelihood, float(other.theta[2])
        if gap < FOLLOWED and all(abs(z - old) > model.fringe_nm / 8 for old in (*near, fit.z_nm)):
            near[z] = gap
    told = [(a.z_nm, a.log_likelihood_gap) for a in fit.alternatives]
    for z, gap in near.items():
        assert any(abs(z - t) < 2.0 and gap == pytest.approx(g, abs=0.01) for t, g in told), (
            z,
            gap,
        )
    for z, gap in told:
        if gap < FOLLOWED and z not in (0.0, 600.0) and gap < fit.log_likelihood - 1e-9:
            assert any(abs(z - n) < 2.0 for n in near), (z, gap)


def _with_every_start(which: Likelihood, start: Candidate, *, level: bool) -> FitResult:
    """Fit a particle where nothing is given up, and the given height is followed too."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("iscat_analysis.inference.fit.FOLLOWED", math.inf)
        patched.setattr("iscat_analysis.inference.fit.PLAIN", math.inf)
        return fit_particle(which, start, "joint", (0.0, 600.0), level=level)


@pytest.mark.parametrize("seed", [308, 13, 4, 6])
def test_a_bad_start_costs_no_optimum(seed: int) -> None:
    """Gold, a pixel and half of the mass off, at times beside a particle nobody knows of."""
    config = make_config(calibrated=False, fit={"z_range_nm": [0.0, 600.0]}, **gold())
    model, grid = forward_model(config, 2500.0), PixelGrid.region((0, 20), (0, 20), PIXEL_NM)
    rng = np.random.default_rng(seed)
    mass = model.material.mass_kda * np.exp(rng.uniform(-1, 1))
    z, (x, y) = rng.uniform(0, 600), 10 + rng.uniform(-3, 3, 2)
    signal = model.image(grid, x * PIXEL_NM, y * PIXEL_NM, z, mass)
    if seed % 2:
        beside = (np.array([x, y]) + rng.uniform(-5, 5, 2)) * PIXEL_NM
        signal += model.image(grid, *beside, rng.uniform(0, 600), mass * rng.uniform(0.3, 1))
    light = 3000.0 * np.array([np.ones(grid.shape), 1 + np.maximum(signal, -0.9)])
    which = noise.conditional(model, grid, *rng.poisson(light), 1.0)
    place, heavier = (x + rng.normal(0, 1), y + rng.normal(0, 1)), math.exp(rng.normal(0, 0.5))
    start = Candidate(*place, 300.0, mass * heavier, 10.0)
    fit = fit_particle(which, start, "joint", (0.0, 600.0), level=True)
    slow = _with_every_start(which, start, level=True)
    assert fit.log_likelihood == pytest.approx(slow.log_likelihood, abs=0.1)
    assert fit.status == slow.status


@pytest.mark.parametrize("pupil", ["round", "gold", "coma"])
@pytest.mark.parametrize("level", [False, True])
def test_a_plain_particle_is_found_without_the_given_height(pupil: str, level: bool) -> None:
    """The given start, wherever it is, would lead to no other maximum."""
    rng = np.random.default_rng(9)
    for seed in range(4):
        case = _case("conditional", light=1e5, pupil=pupil, seed=seed)
        x, y, _, amplitude, _ = case.theta
        place = np.array([x, y]) / PIXEL_NM + rng.uniform(-0.5, 0.5, 2)
        mass = amplitude * rng.uniform(0.5, 1.5)
        start = Candidate(*place, float(rng.uniform(0, 600)), float(mass), 10.0)
        fit = fit_particle(case.likelihood, start, "joint", (0.0, 600.0), level=level)
        slow = _with_every_start(case.likelihood, start, level=level)
        assert fit.log_likelihood > PLAIN
        known = np.isfinite(fit.sigma)
        moved = np.array([getattr(fit, name) - getattr(slow, name) for name in PARAMETERS])
        assert np.all(np.abs(moved[known]) < SETTLED * fit.sigma[known])
        assert (fit.status, fit.flags) == (slow.status, slow.flags)


# ---- the picture at a fixed height ---------------------------------------------------------------


def _through_the_field(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Likelihood, "is_pictured", lambda *_: False)


PICTURES: list[dict[str, object]] = [
    {}, {"polarization_deg": 30.0, "analyzer": True}, {"scheme": "darkfield"},
    {"aberrations_nm": {"z7": 15.0, "z5": 10.0}},
]  # fmt: skip


@pytest.mark.parametrize(
    ("optics", "level"),
    [
        *((optics, bool(k % 2)) for k, optics in enumerate(PICTURES)),
        *(
            pytest.param(optics, not k % 2, marks=pytest.mark.large)
            for k, optics in enumerate(PICTURES)
        ),
    ],
)
def test_a_picture_gives_the_fit_of_the_field(
    optics: dict[str, object], level: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Estimates and their errors to a thousandth of a standard deviation."""
    model = forward_model(make_config(calibrated=False, optics=optics), 2500.0)
    grid, rng = PixelGrid.region((0, 20), (0, 19), PIXEL_NM), np.random.default_rng(8)
    signal = model.image(grid, 9.2 * PIXEL_NM, 10.1 * PIXEL_NM, model.height_nm, 600.0)
    scale = 2e6 if model.rho else 3000 / signal.max()
    before = rng.poisson(1e3 if not model.rho else scale, grid.shape).astype(float)
    after = rng.poisson(before.mean() + scale * signal).astype(float)
    which = (
        noise.conditional(model, grid, before, after, 1.0)
        if model.rho
        else noise.poisson(model, grid, after, 1e3, scale)
    )
    start = Candidate(9.6, 9.8, model.height_nm, 800.0, 10.0)
    begin = start_theta(which, start)
    box = search_box(which, begin, "mass", (0.0, 600.0), level=level)
    assert which.is_pictured(model.height_nm, box.lower, box.upper)
    fast = fit_particle(which, start, "mass", (0.0, 600.0), level=level)
    tight = which.maximize(fast.theta, box, tolerance=1e-10)
    _through_the_field(monkeypatch)
    slow = fit_particle(which, start, "mass", (0.0, 600.0), level=level)
    same = which.maximize(fast.theta, box, tolerance=1e-10)
    known = [0, 1, 3]
    units = 1 / np.sqrt(np.diag(same.fisher))
    assert np.all(np.abs(tight.theta - same.theta)[box.free] < 1e-3 * units[box.free])
    assert fast.status == slow.status
    np.testing.assert_allclose(fast.sigma[known], slow.sigma[known], rtol=1e-3)
    assert fast.snr == pytest.approx(slow.snr, abs=1e-3)


def test_what_has_no_picture_takes_the_field() -> None:
    """Another height, a place whose pixels lie beyond the model, and pixels out of line."""
    model = forward_model(make_config(), 2500.0)
    grid = PixelGrid.region((0, 20), (0, 20), PIXEL_NM)
    which = noise.poisson(model, grid, np.full(grid.shape, 1e4), 1e4, 1e4)
    low, high = np.full(5, 700.0), np.full(5, 900.0)
    assert which.is_pictured(model.height_nm, low, high)
    assert not which.is_pictured(model.height_nm + 1.0, low, high)
    assert not which.is_pictured(model.height_nm, low - 700, high + 700)
    askew = PixelGrid(np.sort(np.append(grid.x_nm[:-1], 10.0)), grid.y_nm, PIXEL_NM)
    other = noise.poisson(model, askew, np.full(grid.shape, 1e4), 1e4, 1e4)
    assert not other.is_pictured(model.height_nm, low, high)


@pytest.mark.parametrize("rows", [5, 16, 35])
@pytest.mark.parametrize("kind", ["conditional", "poisson"])
def test_strips_of_a_picture_are_scored_as_its_rows(kind: str, rows: int) -> None:
    """Less than a strip, one, and more than two."""
    model = forward_model(make_config(calibrated=False), 4000.0)
    grid = PixelGrid.region((0, rows), (0, 13), PIXEL_NM)
    theta = np.array([6.3 * PIXEL_NM, 0.4 * rows * PIXEL_NM, model.height_nm, 900.0, 0.02])
    counts = np.random.default_rng(rows).poisson(1e3, (2, *grid.shape)).astype(float)
    which = (
        noise.conditional(model, grid, *counts, 1.0)
        if kind == "conditional"
        else noise.poisson(model, grid, counts[1], 1e3, 1e3)
    )
    lens, table = model.picture_table(PIXEL_NM, max(grid.shape))
    pixels, out = model.pixels(grid), np.empty((rows, 5, 13))
    profile = picture_at(
        table, lens, model.height_nm, 0, table.heights.shape[3], np.empty((0, 0, 0))
    )
    got, score, wanted = np.empty((5, 5)), np.empty((2, 5)), np.empty((5, 5))
    value = score_pass(profile, lens, pixels, which.measured, theta, (score[0], got))
    signal_gradient(profile, lens, pixels, theta, out)
    there = image_score(which.measured, math.exp(theta[LEVEL]), out, (score[1], wanted))
    assert value == pytest.approx(there, rel=1e-10)
    unit = np.sqrt(np.diag(wanted) + 1e-300)
    np.testing.assert_allclose(score[0] / unit, score[1] / unit, atol=1e-9)
    np.testing.assert_allclose(got, wanted, atol=1e-12 * np.outer(unit, unit).max(), rtol=1e-10)


# ---- the largest contrast ------------------------------------------------------------------------


@pytest.mark.parametrize("optics", [
    {}, {"analyzer": True}, {"polarization": "circular"},
    {"polarization": "circular", "analyzer": True}, {"scheme": "darkfield"},
    {"aberrations_nm": {"z5": 12.0, "z7": -9.0}},
    {"aberrations_nm": {"z5": 12.0}, "analyzer": True},
])  # fmt: skip
def test_largest_contrast(optics: dict[str, object]) -> None:
    model = forward_model(make_config(calibrated=False, optics=optics), 1500.0)
    fine = PixelGrid.centred(401, 4.0)
    for z, mass in ((5.0, 1000.0), (80.0, 1e5), (60.0, -2e4)):
        image = model.amplitude_image(fine, 0.0, 0.0, z, mass)
        largest = float(image.flat[np.argmax(np.abs(image))])
        assert model.amplitude_contrast(z, mass) == pytest.approx(largest, rel=2e-4)
        assert model.amplitude_contrast(z, mass, "between") == pytest.approx(
            model.amplitude_contrast(z, mass), rel=1e-7
        )


@pytest.mark.parametrize("place", [600.0, -900.0])
def test_a_place_that_is_held_may_lie_outside_the_bounds(place: float) -> None:
    """Bounds of what is not free do not say how far a picture must reach."""
    model, grid = forward_model(make_config(), 4000.0), PixelGrid.region((0, 20), (0, 20), PIXEL_NM)
    counts = np.random.default_rng(0).poisson(1e4, grid.shape).astype(float)
    which = noise.poisson(model, grid, counts, 1e4, 1e4)
    amplitude = model.scale.amplitude(model.material.mass_kda)
    start = np.array([place, place, model.height_nm, amplitude, 0.0])
    end = 100 * abs(amplitude)
    lower, upper = np.array([0.0, 0.0, 0.0, -end, 0.0]), np.array([1200.0, 1200.0, 500.0, end, 0.0])
    free = np.array([False, False, False, True, False])
    found = which.maximize(start, Box(free, lower, upper), passes=1)
    assert found.log_likelihood == pytest.approx(which.values(start[None])[0], abs=1e-3)


@pytest.mark.parametrize("gradient_per_kda", [-3.1e-5, -1.0])
def test_a_picture_is_exact_on_its_nodes_in_any_unit_of_mass(gradient_per_kda: float) -> None:
    """Neither of its two parts drowns in the rounding of the other, however bright a particle."""
    config = make_config().model_copy(
        update={"calibration": Calibration.model_construct(gradient_per_kda=gradient_per_kda)}
    )
    model = forward_model(config, 2200.0)
    lens, table = model.picture_table(PIXEL_NM, max(GRID.shape))
    x, y = 6 * PIXEL_NM, 7 * PIXEL_NM
    amplitude = 0.5 / abs(model.amplitude_contrast(model.height_nm, 1.0))
    field = model.amplitude_image(GRID, x, y, model.height_nm, amplitude)
    picture = np.empty(GRID.shape)
    nodes = 2 * lens.half + 1
    theta = np.array([x, y, model.height_nm, amplitude])
    profile = table.heights[0, 0].reshape(2, nodes, -1)
    signal_image(profile, lens, model.pixels(GRID), theta, picture)
    assert np.abs(picture - field).max() < 1e-12
