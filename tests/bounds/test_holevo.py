"""The Holevo bound: numbers of physics.md, section 9, and the order of the bounds."""

from __future__ import annotations

import math

import numpy as np
import pytest

from iscat_analysis.bounds import (
    bounds_report,
    holevo_bound,
    holevo_over_quantum,
    natural_bound,
    plan,
    quantum_information,
    tradeoff,
)
from iscat_analysis.bounds.paper import paper_config
from iscat_analysis.config import load_config
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.forward import ForwardModel, forward_model
from iscat_analysis.records import PARAMETERS

SOLVER = 5e-8
"""Relative error of the semidefinite program; the closed forms are exact."""

OTHER = (
    "optics.wavelength_nm=525",
    "optics.na=1.42",
    "optics.n_immersion=1.515",
    "optics.n_glass=1.515",
    "camera.pixel_size_nm=84",
)


def on_the_glass(name: str) -> ForwardModel:
    if name in ("iscat", "cobri"):
        return forward_model(paper_config(name, z_nm=0.0), 1500.0)
    return forward_model(load_config(None, OTHER), 1500.0)


@pytest.mark.parametrize(
    ("name", "beta", "total", "ratio"),
    [
        ("iscat", 0.993626, 3.594775747, 1.3407),
        ("cobri", 0.813104, 2.528255014, 1.1243),
        ("NA 1.42", 0.967771, 3.195320369, 1.2654),
    ],
)
def test_numbers_of_height_and_mass(name: str, beta: float, total: float, ratio: float) -> None:
    model = on_the_glass(name)
    both = quantum_information(model, 0.0)[2:, 2:]
    own = np.sqrt(np.diag(both).real)
    found = natural_bound(both)
    assert found.sum == pytest.approx(total, abs=1e-9)
    assert found.sigma * own == pytest.approx([ratio] * 2, abs=5e-5)
    conflict = abs(both[0, 1].imag) / math.sqrt(np.linalg.det(both.real))
    assert conflict == pytest.approx(beta, abs=1e-6)
    assert holevo_bound(both, both.real).sum == pytest.approx(total, rel=SOLVER)
    cost = holevo_over_quantum(model, 0.0, PARAMETERS)
    assert cost["z_nm"] == pytest.approx(ratio, abs=5e-5)
    assert cost["x_nm"] == pytest.approx(1.0, abs=1e-12)  # x and y conflict with nothing


def random_information(rng: np.random.Generator, size: int) -> np.ndarray:
    light = rng.normal(size=(size, size)) + 1j * rng.normal(size=(size, size))
    scale = 10.0 ** rng.uniform(-3, 3, size)
    return np.asarray(light.conj().T @ light * np.outer(scale, scale))


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5])
def test_the_closed_form_is_the_semidefinite_program(size: int) -> None:
    rng = np.random.default_rng(size)
    for _ in range(8):
        information = random_information(rng, size)
        exact, solved = natural_bound(information), holevo_bound(information, information.real)
        assert solved.sum == pytest.approx(exact.sum, rel=SOLVER)
        assert size <= exact.sum <= 2 * size
        assert np.trace(information.real @ exact.covariance) == pytest.approx(exact.sum)


def test_the_trade_off_is_the_semidefinite_program_for_every_weight() -> None:
    rng = np.random.default_rng(11)
    for _ in range(4):
        information = random_information(rng, 2)
        own = 1 / np.sqrt(np.diag(information).real)
        edge = tradeoff(information, 9)
        shares = np.linspace(0, math.pi / 2, 11)[1:-1]
        for sigma, share in zip(edge, shares, strict=True):
            weight = np.diag(np.array([math.cos(share), math.sin(share)]) ** 2 / own**2)
            best = holevo_bound(information, weight).sum
            assert np.sum(np.diag(weight) * sigma**2) == pytest.approx(best, rel=SOLVER)
        assert np.all(edge > own)


def test_no_measurement_does_better_than_a_weight_allows() -> None:
    """A control: below the curve the program has no point, whatever its weight."""
    information = np.array([[1.0, 0.9j], [-0.9j, 1.0]])
    for sigma in tradeoff(information, 7) * 0.999:
        weights = np.linspace(0.02, 0.98, 33)
        margins = [
            w * sigma[0] ** 2 + (1 - w) * sigma[1] ** 2
            - holevo_bound(information, np.diag([w, 1 - w])).sum
            for w in weights
        ]  # fmt: skip
        assert min(margins) < -SOLVER


def random_setup(rng: np.random.Generator) -> list[str]:
    polarization, analyzer = ("linear", "circular")[rng.integers(2)], rng.integers(2)
    return [
        f"optics.scheme={('iscat', 'cobri')[rng.integers(2)]}",
        f"optics.na={rng.uniform(0.7, 1.49)}",
        f"optics.focus_nm={rng.uniform(-1500, 1500)}",
        f"optics.reference_phase_deg={rng.uniform(-90, 90)}",
        f"optics.polarization={polarization}",
        f"optics.analyzer={'true' if analyzer else 'false'}",
        f"optics.aberrations_nm={{z11={rng.uniform(-30, 30)}}}",
        f"particle.height_nm={rng.uniform(0, 800)}",
        f"bounds.n_before={rng.integers(0, 3)}",
        "fit.mode=joint",
        "camera.pixel_size_nm=70",
        "bounds.pixels=25",
    ]


def assert_ordered(count: int, seed: int) -> None:
    """Ask for CRB ≥ Holevo ≥ QCRB in random microscopes."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        experiment = plan(load_config(None, random_setup(rng)))
        classical = experiment.bounds(PARAMETERS)
        if classical.unidentifiable:
            continue
        light = experiment.light(PARAMETERS)
        together = natural_bound(light)
        reached = np.trace(light.real @ np.linalg.inv(classical.fisher))
        assert reached >= together.sum >= 4 - 1e-12
        single = 1 / np.sqrt(np.diag(light).real)
        assert np.all(together.sigma >= single * (1 - 1e-12))


def test_bounds_are_in_order() -> None:
    assert_ordered(40, seed=5)


@pytest.mark.large
def test_bounds_are_in_order_in_thousands_of_microscopes(share: float) -> None:
    assert_ordered(round(3000 * share), seed=6)


def test_the_report_says_what_can_be_had_at_once() -> None:
    config = load_config(None, [*OTHER, "fit.mode=joint", "particle.mass_kda=480"])
    report = bounds_report(config)
    found, actual = report["holevo"], report["actual"]
    assert found["weight"] == "qfi"
    for name in PARAMETERS:
        assert actual["qcrb"][name] * (1 - 1e-12) <= found[name] <= actual["crb_joint"][name]
        share = (found[name] / actual["crb_joint"][name]) ** 2
        assert report["information_fraction_joint"][name] == pytest.approx(share)
    assert found["z_nm"] / actual["qcrb"]["z_nm"] == pytest.approx(1.2654, abs=1e-3)
    alone = bounds_report(load_config(None, [*OTHER, "fit.mode=mass"]))
    assert alone["holevo"]["sum"] == pytest.approx(3.0)
    assert "z_nm" not in alone["holevo"]


@pytest.mark.parametrize(
    ("information", "word"),
    [
        (np.eye(3)[:2], "square"),
        (np.array([[1, np.nan], [np.nan, 1]]), "finite"),
        (np.array([[1, 1j], [1j, 1]]), "Hermitian"),
        (np.diag([1.0, -1.0]), "positive"),
        (np.ones((2, 2)), "independent"),
    ],
)
def test_bad_information_is_refused(information: np.ndarray, word: str) -> None:
    with pytest.raises(ConfigError, match=word):
        natural_bound(information)


def test_bad_weights_are_refused() -> None:
    with pytest.raises(ConfigError, match="shape"):
        holevo_bound(np.eye(2), np.eye(3))
    with pytest.raises(ConfigError, match="semidefinite"):
        holevo_bound(np.eye(2), np.diag([1.0, -1.0]))
    with pytest.raises(ConfigError, match=r"\(2, 2\)"):
        tradeoff(np.eye(3))
