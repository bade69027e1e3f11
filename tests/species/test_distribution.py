"""Species from events: what the pieces promise."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import approx_fprime
from scipy.special import log_ndtr, logsumexp
from scipy.stats import ks_2samp, norm

from iscat_analysis._kernels.mixture import detection_score, mixture_score
from iscat_analysis.species import (
    LEAST_EVENTS,
    SPECIES_COLUMNS,
    Efficiency,
    Number,
    Searched,
    describe,
)
from iscat_analysis.species.choices import ascend, height
from iscat_analysis.species.events import Edge, Events
from iscat_analysis.species.mixture import Mixture
from iscat_analysis.species.repeats import draw_events


def sample(seed: int = 1, n: int = 200) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    rng = np.random.default_rng(seed)
    sigma = rng.uniform(4, 9, n)
    true = np.where(np.arange(n) < n // 2, 66.0, 200.0)
    sign = np.where(np.arange(n) % 4 == 0, -1.0, 1.0)
    return sign * rng.normal(true, sigma), sigma


def test_the_likelihood_is_that_of_scipy_and_so_is_its_slope() -> None:
    x, sigma = np.abs(sample()[0]), sample()[1]
    weight, mean, variance = np.array([0.3, 0.7]), np.array([70.0, 190.0]), np.array([9.0, 100.0])

    def value(theta: NDArray[np.float64]) -> float:
        w, m, v = np.exp(theta[:2]), theta[2:4], theta[4:]
        return float(mixture_score(x, sigma**2, (w, m, v))[0])

    densities = norm.pdf(x[:, None], mean, np.sqrt(variance + sigma[:, None] ** 2))
    expected = np.log(densities @ weight).sum()
    found, gradient = mixture_score(x, sigma**2, (weight, mean, variance))
    assert found == pytest.approx(expected, rel=1e-12)
    theta = np.concatenate([np.log(weight), mean, variance])
    assert np.allclose(gradient.ravel(), approx_fprime(theta, value, 1e-6), rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("same_noise", [False, True])
def test_what_detection_takes_off_is_that_of_scipy_and_so_is_its_slope(same_noise: bool) -> None:
    x, sigma = np.abs(sample(n=40)[0]), sample(n=40)[1]
    efficiency = Efficiency(5.0, 12.0 if same_noise else 6.0)
    events = Events(x, sigma, efficiency)
    theta = np.array([-1.2, -0.4, 50.0, 190.0, 9.0, 100.0])

    def found(theta: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        mixture = Mixture(np.exp(theta[:2]), theta[2:4], theta[4:])
        value, slopes = detection_score(
            events.filter_variance[:, 0], efficiency.threshold_kda, 40 if same_noise else 1,
            (mixture.weight, mixture.mean, mixture.variance),
        )  # fmt: skip
        return value, slopes.ravel()

    noise = np.maximum(sigma, efficiency.sigma_kda)
    spread = np.sqrt(theta[4:] + noise[:, None] ** 2)
    seen = norm.sf(efficiency.threshold_kda, theta[2:4], spread) @ np.exp(theta[:2])
    expected = np.log(seen).sum()
    value, slope = found(theta)
    assert value == pytest.approx(expected, rel=1e-10)
    numerical = approx_fprime(theta, lambda theta: found(theta)[0], 1e-6)
    assert np.allclose(slope, numerical, rtol=1e-4, atol=1e-4)


def test_far_from_every_species_the_likelihood_goes_on() -> None:
    """Where densities vanish in double precision, sums of logarithms take their place."""
    noise, x = np.array([4.0, 9.0]), np.array([500.0, 15.0])
    w, m, v = np.array([0.3, 0.7]), np.array([10.0, 20.0]), np.array([1.0, 4.0])
    spread = np.sqrt(v + noise[:, None])
    expected = logsumexp(np.log(w) + norm.logpdf(x[:, None], m, spread), axis=1).sum()
    value, slope = mixture_score(x, noise, (w, m, v))
    assert value == pytest.approx(expected, rel=1e-12)
    numerical = approx_fprime(m, lambda m: mixture_score(x, noise, (w, m, v))[0], 1e-5)
    assert np.allclose(slope[1], numerical, rtol=1e-3)
    expected = logsumexp(np.log(w) + log_ndtr((m - 200) / spread), axis=1).sum()
    value, slope = detection_score(noise, 200.0, 1, (w, m, v))
    assert value == pytest.approx(expected, rel=1e-12)
    numerical = approx_fprime(m, lambda m: detection_score(noise, 200.0, 1, (w, m, v))[0], 1e-5)
    assert np.allclose(slope[1], numerical, rtol=1e-3, atol=1e-6)


def test_a_step_of_em_is_what_its_definition_says_for_any_number_of_events() -> None:
    """The kernel takes events by blocks, and exponentials by a series of its own."""
    rng = np.random.default_rng(4)
    w, m, v = np.array([0.2, 0.5, 0.3]), np.array([60.0, 90.0, 300.0]), np.array([0.0, 9.0, 1e4])
    for n in (1, 127, 128, 129, 300):
        x, noise = rng.uniform(0, 700, n), rng.uniform(2, 90, n)
        x[0] = 1e4  # where densities vanish
        density = np.log(w) + norm.logpdf(x[:, None], m, np.sqrt(v + noise[:, None]))
        share = np.exp(density - logsumexp(density, axis=1, keepdims=True))
        true = m + v / (v + noise[:, None]) * (x[:, None] - m)
        size = share.sum(axis=0) + 1e-12
        mean = m + (share * (true - m)).sum(axis=0) / size
        square = (share * ((true - m) ** 2 + (v / (v + noise[:, None])) * noise[:, None])).sum(0)
        events = Events(x, np.sqrt(noise), None, plain=True)
        found = ascend(events, Mixture(w, m, v), 1)
        assert found.weight == pytest.approx(size / n, rel=1e-11)
        assert found.mean == pytest.approx(mean, rel=1e-11)
        assert found.variance == pytest.approx(square / size - (mean - m) ** 2, rel=1e-9, abs=1e-9)
        value, _ = mixture_score(x, noise, (w, m, v))
        assert value == pytest.approx(logsumexp(density, axis=1).sum(), rel=1e-12)


def test_em_never_goes_down() -> None:
    x, sigma = np.abs(sample()[0]), sample()[1]
    events = Events(x, sigma, None, plain=True)
    start = Mixture(np.array([0.5, 0.5]), np.array([20.0, 300.0]), np.array([900.0, 900.0]))
    values = [height(events, ascend(events, start, steps)) for steps in range(30)]
    assert np.all(np.diff(values) > -1e-9)


def test_the_table_of_species() -> None:
    mass, sigma = sample()
    found = describe(mass, sigma, seed=1, draws=40)
    assert list(found.species.columns) == list(SPECIES_COLUMNS)
    assert len(found.species) == 2
    assert found.species["mass_kda"].is_monotonic_increasing
    assert found.species["fraction"].sum() == pytest.approx(1)
    assert found.species["count"].sum() == pytest.approx(200)
    assert (found.species["landing"] + found.species["leaving"]).tolist() == pytest.approx(
        found.species["count"].tolist()
    )
    assert found.species["leaving"].tolist() == pytest.approx([25, 25], abs=1)
    for name, of in (("mass", "mass_kda"), ("width", "width_kda"), ("fraction", "fraction")):
        assert (found.species[f"{name}_low"] <= found.species[of] + 1e-6).all()
        assert (found.species[f"{name}_high"] >= found.species[of] - 1e-6).all()
    assert found.selection["delta_bic"].min() == 0
    assert found.support > 0.8


def test_the_same_seed_gives_the_same_numbers() -> None:
    mass, sigma = sample()
    first, again, other = (
        describe(mass, sigma, seed=seed, draws=10).to_dict() for seed in (3, 3, 4)
    )
    assert json.dumps(first) == json.dumps(again)
    assert first["species"][0]["mass_se"] != other["species"][0]["mass_se"]


def test_branches_take_one_side_each() -> None:
    mass, sigma = sample()
    both = describe(mass, sigma, seed=1, draws=0)
    landing = describe(mass, sigma, seed=1, draws=0, branch="landing")
    leaving = describe(mass, sigma, seed=1, draws=0, branch="leaving")
    assert (both.events, landing.events, leaving.events) == (200, 150, 50)
    assert landing.species["leaving"].sum() == leaving.species["landing"].sum() == 0


def test_few_events_are_listed_and_not_described() -> None:
    for n in (0, 1, LEAST_EVENTS - 1):
        mass, sigma = sample(n=n)
        found = describe(mass, sigma, seed=1)
        assert found.species.empty
        assert found.histogram["count"].sum() == n
        assert any("too few" in note for note in found.notes)
        json.dumps(found.to_dict())


def test_one_event_apart_is_no_species() -> None:
    """It is background, which has events and nothing else, and spoils no species."""
    mass, sigma = sample()
    found = describe(np.append(mass, 400.0), np.append(sigma, 6.0), seed=1, draws=4)
    assert found.species["outlier"].tolist() == [False, False, True]
    assert found.species["background"].tolist() == [False, False, True]
    assert found.species["count"].iloc[-1] == pytest.approx(1, abs=0.7)
    nothing = found.species.iloc[-1][["mass_kda", "mass_se", "width_kda", "fraction"]]
    assert nothing.isna().all()
    assert found.species["width_kda"].iloc[1] < 5
    asked = describe(
        np.append(mass, 400.0), np.append(sigma, 6.0), seed=1, draws=0, choice=Number(3)
    )
    assert asked.species["outlier"].tolist() == [False, False, True]
    assert any("at 400 kDa there are fewer than 3 events" in note for note in asked.notes)


def test_an_event_apart_takes_no_part_of_the_particles_that_came() -> None:
    """One event where one in 200 is detected stood for more particles than all others."""
    mass, sigma = sample()
    mass = np.abs(mass) + 60
    seen = Efficiency(30.0, 7.0)
    alone = describe(mass, sigma, efficiency=seen, seed=1, draws=20).species
    found = describe(
        np.append(mass, 12.0), np.append(sigma, 6.0), efficiency=seen, seed=1, draws=20
    ).species
    hardly = found["efficiency"] < 0.05
    assert hardly.any()
    nothing = found.loc[hardly, ["count_corrected", "mass_low", "mass_high", "fraction"]]
    assert nothing.isna().all(axis=None)
    assert found["fraction"].sum() == pytest.approx(1)
    for name in ("fraction", "fraction_low", "fraction_high", "count_corrected"):
        np.testing.assert_allclose(found[name].iloc[-1], alone[name].iloc[-1], rtol=0.05)


def test_events_far_below_what_is_detected_stop_nothing() -> None:
    mass, sigma = sample()
    found = describe(
        np.append(1.5 * mass, [0.5, 2.0]), np.append(sigma, [9.0, 9.0]),
        efficiency=Efficiency(5.0, 12.0), seed=1, draws=10,
    )  # fmt: skip
    real = found.species[found.species["efficiency"] > 0.9]
    assert (real["corrected_low"] < real["count_corrected"]).all()
    assert (real["corrected_high"] > real["count_corrected"]).all()
    assert any("mass and number are not determined" in note for note in found.notes)


@pytest.mark.parametrize(
    "efficiency",
    [None, Efficiency(5.0, 12.0), Efficiency(5.0, 7.0), Edge.at(58.0, 9.0), Edge.at(58.0, 0.0)],
)
def test_a_drawn_event_is_one_that_was_drawn_and_then_detected(
    efficiency: Efficiency | None,
) -> None:
    rng = np.random.default_rng(1)
    mixture = Mixture(np.array([0.5, 0.5]), np.array([50.0, 70.0]), np.array([25.0, 100.0]))
    for noise in (4.0, 9.0):  # below and above that of the filter
        found = draw_events(Events(np.ones(1), np.array([noise]), efficiency), mixture, 20_000, rng)
        species = rng.integers(2, size=100_000)
        true = rng.normal(mixture.mean[species], np.sqrt(mixture.variance[species]))
        x = rng.normal(true, noise)
        if efficiency is not None:
            extra = float(efficiency.extra_sigma(np.array([noise]))[0])
            x = x[rng.normal(x, extra) > efficiency.threshold_kda]
        assert ks_2samp(found.x, np.abs(x)).pvalue > 1e-3


def test_rounding_makes_no_width() -> None:
    mean = np.array([60.75, 2.1 * 60.75, 7.3 * 60.75])
    mixture = Mixture(np.array([0.333, 0.4, 0.267]), mean, np.zeros(3))
    assert mixture.widths().tolist() == [0.0, 0.0, 0.0]


def test_missing_values_are_left_out() -> None:
    mass, sigma = sample()
    mass[0], sigma[1], sigma[2] = math.nan, math.nan, 0.0
    found = describe(mass, sigma, seed=1, draws=0)
    assert found.events == 197
    assert any("3 events without a mass and an error" in note for note in found.notes)


def test_impossible_options_are_refused() -> None:
    with pytest.raises(ValueError, match="masses but"):
        describe([1.0], [1.0, 2.0], seed=1)
    with pytest.raises(ValueError, match="efficiency needs"):
        Efficiency(5.0, 0.0)


def test_curves_hold_the_events() -> None:
    mass, sigma = sample()
    found = describe(mass, sigma, seed=1, draws=0)
    step = found.curves["mass_kda"][1]
    for name in ("density", "model"):
        assert found.curves[name].sum() * step == pytest.approx(200, rel=0.02)
    counts = found.histogram
    assert counts["count"].sum() == 200
    assert (
        (counts["count_low"] <= counts["count"]) & (counts["count"] <= counts["count_high"])
    ).all()
    # Garwood's interval of no events at all: 0 to −ln 0.025.
    empty = counts[counts["count"] == 0]
    assert empty["count_high"].tolist() == pytest.approx([-math.log(0.025)] * len(empty))


def test_efficiency_is_half_at_the_threshold() -> None:
    efficiency = Efficiency(5.0, 12.0)
    assert efficiency.threshold_kda == 60
    assert efficiency([60.0]).tolist() == [0.5]
    assert efficiency(84.0) == pytest.approx(norm.cdf(2))
    mass, sigma = sample()
    found = describe(mass, np.minimum(sigma, 12.0), efficiency=efficiency, seed=1, draws=0)
    light = found.species.iloc[0]
    assert light["count_corrected"] == pytest.approx(light["count"] / light["efficiency"], rel=1e-3)
    assert found.curves["efficiency"].is_monotonic_increasing


@pytest.mark.parametrize("mean", [-300.0, -120.0, -99.0, 0.0, 300.0])
def test_far_below_the_threshold_the_chance_is_that_of_scipy(mean: float) -> None:
    one = (np.array([1.0]), np.array([mean]), np.array([0.0]))
    value, slopes = detection_score(np.array([25.0]), 0.0, 1, one)
    assert value == pytest.approx(float(log_ndtr(mean / 5)), rel=1e-9)
    hazard = math.exp(norm.logpdf(mean / 5) - float(log_ndtr(mean / 5)))
    assert slopes[1, 0] == pytest.approx(hazard / 5, rel=1e-6)


def test_efficiency_is_stated_for_stays_as_long_as_the_window() -> None:
    """A visitor of d of n frames has d/n of its contrast, and is found like such a particle."""
    rng = np.random.default_rng(21)
    window, threshold, noise = 40, 5.0, 6.0
    mass = np.abs(rng.normal(480.0, 8.0, 200))
    efficiency = Efficiency(threshold, noise)
    found = describe(
        mass, np.full(200, 6.0), efficiency=efficiency, seed=1, draws=0, choice=Searched(1),
        window_frames=window,
    )  # fmt: skip
    (species,) = found.species.to_dict("records")
    assert species["efficiency"] > 0.999
    assert species["stay_frames"] == math.ceil(window * threshold * noise / 480.0) == 3
    brief = {d: float(efficiency(480.0 * d / window)) for d in (2, 3)}
    assert brief[2] < 0.5 < brief[3]
    (note,) = [note for note in found.notes if "stay" in note]
    assert "stay 40 frames or longer" in note
    assert "480 kDa from 3 frames" in note
    without = describe(mass, np.full(200, 6.0), seed=1, draws=0, choice=Searched(1))
    assert not any("stay" in note for note in without.notes)


def test_events_that_only_crowd_the_threshold_stop_nothing() -> None:
    """Noise falls off so steeply above the threshold that the likeliest species has no mass.

    Of an exponential of an eighth of the noise the mass was 0 and the number 10^9.
    """
    noise = 6.0
    mass = 5 * noise + np.random.default_rng(3).exponential(noise / 8, 200)
    found = describe(
        mass, np.full(200, noise), efficiency=Efficiency(5.0, noise), seed=1, draws=0,
        choice=Searched(1), window_frames=40,
    )  # fmt: skip
    (species,) = found.species.to_dict("records")
    assert 15 < species["mass_kda"] < 5 * noise
    assert species["efficiency"] < 0.05
    for name in ("stay_frames", "count_corrected", "fraction", "mass_low", "mass_high"):
        assert math.isnan(species[name])
    assert any("mass and number are not determined" in note for note in found.notes)
