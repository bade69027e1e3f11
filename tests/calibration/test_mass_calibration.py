"""Contrast against mass: the line in its standard errors, peaks from events, and clear refusals."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize
from shared_errors import systematic

from iscat_analysis import calibration as peaks
from iscat_analysis.answers.calibrations import read_contrasts
from iscat_analysis.calibration import (
    calibrate_mass,
    find_contrast_peaks,
    mass_from_contrast,
    york_line,
)
from iscat_analysis.config import configure, parse_config
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.movie.tables import read_events
from iscat_analysis.species import Searched, describe
from iscat_analysis.species.tables import event_table

STANDARDS = (66.0, 146.0, 480.0)
GRADIENT, OFFSET = -3.1e-5, 2e-4
NOISE = 2.5e-4


def events(
    rng: np.random.Generator,
    masses: tuple[float, ...] = STANDARDS,
    *,
    count: int = 150,
    leaving: int = 20,
    gradient: float = GRADIENT,
    offset: float = OFFSET,
) -> NDArray[np.float64]:
    """Signed contrasts of landing and leaving particles."""
    landed = np.concatenate(
        [gradient * m + offset + NOISE * rng.standard_normal(count) for m in masses]
    )
    left = np.concatenate(
        [-(gradient * m + offset) + NOISE * rng.standard_normal(leaving) for m in masses]
    )
    return rng.permutation(np.concatenate([landed, left]))


def test_york_agrees_with_brute_force() -> None:
    rng = np.random.default_rng(1)
    for _ in range(10):
        n = 6
        x_true = np.sort(rng.uniform(0, 10, n))
        sx, sy = rng.uniform(0.05, 0.5, (2, n))
        x, y = x_true + sx * rng.standard_normal(n), 2 * x_true + 1 + sy * rng.standard_normal(n)
        line = york_line(x, sx, y, sy)

        def distance(
            theta: NDArray[np.float64],
            x: NDArray[np.float64] = x,
            y: NDArray[np.float64] = y,
            sx: NDArray[np.float64] = sx,
            sy: NDArray[np.float64] = sy,
        ) -> float:
            a, b, *place = theta
            p = np.array(place)
            return float(np.sum(((x - p) / sx) ** 2 + ((y - a * p - b) / sy) ** 2))

        start = np.concatenate([[line.slope * 1.02, line.intercept - 0.1], x])
        brute = minimize(distance, start, method="BFGS", options={"gtol": 1e-8})
        assert line.slope == pytest.approx(brute.x[0], rel=1e-5)
        assert line.intercept == pytest.approx(brute.x[1], abs=1e-4)
        assert line.chi2 == pytest.approx(brute.fun, rel=1e-6)
        assert line.dof == n - 2


def test_york_without_errors_in_x_is_weighted_least_squares() -> None:
    x, y, sy = [1.0, 2.0, 4.0, 7.0], [1.1, 2.3, 3.9, 7.2], [0.1, 0.2, 0.1, 0.3]
    line = york_line(x, [0.0] * 4, y, sy)
    design = np.stack([x, np.ones(4)], axis=1) / np.array(sy)[:, None]
    normal = design.T @ design
    expected = np.linalg.solve(normal, design.T @ (np.array(y) / sy))
    assert [line.slope, line.intercept] == pytest.approx(expected.tolist(), rel=1e-10)
    assert np.allclose(line.covariance, np.linalg.inv(normal), rtol=1e-10)


def test_york_errors_are_those_of_repetitions() -> None:
    rng = np.random.default_rng(2)
    x_true, sx, sy = np.array([1.0, 3.0, 8.0]), np.full(3, 0.05), np.full(3, 0.08)
    pulls = []
    for _ in range(400):
        x = x_true + sx * rng.standard_normal(3)
        y = 2 * x_true + 1 + sy * rng.standard_normal(3)
        line = york_line(x, sx, y, sy)
        pulls.append(
            [
                (line.slope - 2) / math.sqrt(line.covariance[0, 0]),
                (line.intercept - 1) / math.sqrt(line.covariance[1, 1]),
            ]
        )
    table = np.array(pulls)
    assert np.all(np.abs(table.mean(axis=0)) < 4 / 20)
    assert np.all(np.abs(table.std(axis=0) - 1) < 4 / math.sqrt(800))


def test_york_needs_a_line() -> None:
    with pytest.raises(ValueError, match="two different x"):
        york_line([1.0, 1.0], [0.1, 0.1], [1.0, 2.0], [0.1, 0.1])
    with pytest.raises(ValueError, match="positive errors"):
        york_line([1.0, 2.0], [0.1, 0.1], [1.0, 2.0], [0.1, 0.0])


@pytest.mark.parametrize("known_errors", [False, True])
def test_the_line_is_recovered_in_standard_errors(known_errors: bool) -> None:
    pulls, widths = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        truth = np.array(STANDARDS) * (1 + 0.01 * rng.standard_normal(3))
        contrast = events(rng, tuple(truth))
        sigmas = np.full(contrast.shape, NOISE) if known_errors else None
        found = calibrate_mass(contrast, STANDARDS, sigmas=sigmas)
        pulls.append(
            [
                (found.gradient_per_kda - GRADIENT) / math.sqrt(found.covariance[0, 0]),
                (found.offset - OFFSET) / math.sqrt(found.covariance[1, 1]),
            ]
        )
        widths += (found.standards["width"] / NOISE).tolist()
    table = np.array(pulls)
    assert np.all(np.abs(table.mean(axis=0)) < 4 / math.sqrt(20)), table.mean(axis=0)
    assert np.all(table.std(axis=0, ddof=1) < 1.6), table.std(axis=0)
    # With the errors known, hardly any width is left beyond them.
    assert np.median(widths) < 0.3 if known_errors else 0.85 < np.median(widths) < 1.1


@pytest.mark.parametrize("known_errors", [False, True])
def test_a_peak_is_fitted_to_its_maximum(
    known_errors: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From where fits end, a search with differences in place of the gradient gains nothing."""
    fitted = []
    fit = peaks.fit_peak

    def recorded(*window: Any) -> peaks.ContrastPeak:
        fitted.append((window, fit(*window)))
        return fitted[-1][1]

    monkeypatch.setattr(peaks, "fit_peak", recorded)
    for seed in range(3):
        size = np.abs(events(np.random.default_rng(seed)))
        find_contrast_peaks(size, np.full(size.shape, NOISE if known_errors else 0.0))
    assert len(fitted) > 15
    for (x, sigma, window, centre, width), peak in fitted:
        share = peak.count / x.size
        theta = np.array([
            (peak.contrast - centre) / width,
            math.log(peak.width / width),
            math.log(share / (1 - share)),
        ])  # fmt: skip

        def loss(at: NDArray[np.float64], given: Any = (x, sigma, window, centre, width)) -> float:
            return peaks.peak_loss(*given, at)[0]

        bounds = [(-1.5, 1.5), (-2.5, 1.0), (-3.0, 6.0)]
        best = minimize(loss, theta, method="L-BFGS-B", bounds=bounds, options={"maxiter": 30})
        assert loss(theta) - best.fun < 1e-3


def test_peaks_are_unbiased_on_a_background() -> None:
    pulls = []
    for seed in range(20):
        rng = np.random.default_rng(50 + seed)
        size = np.concatenate(
            [0.004 + NOISE * rng.standard_normal(200), rng.uniform(0.001, 0.008, 100)]
        )
        peaks = find_contrast_peaks(size, np.zeros(size.shape))
        best = max(peaks, key=lambda peak: peak.count)
        pulls.append((best.contrast - 0.004) / best.contrast_se)
    assert abs(np.mean(pulls)) < 4 / math.sqrt(20)
    assert np.std(pulls) < 1.6


def test_prediction_intervals_hold_the_mass(repetitions: Callable[[int, int], int]) -> None:
    rng = np.random.default_rng(3)
    inside = []
    for _ in range(repetitions(16, 40)):
        truth = np.array(STANDARDS) * (1 + 0.01 * rng.standard_normal(3))
        found = calibrate_mass(events(rng, tuple(truth), count=80, leaving=0), STANDARDS)
        contrast = GRADIENT * 250 + OFFSET + NOISE * rng.standard_normal(20)
        low, high = found.prediction_interval(contrast, NOISE)
        inside.append(np.mean((low < 250) & (high > 250)))
    share = float(np.mean(inside))
    assert abs(share - 0.95) < 4 * float(np.std(inside)) / math.sqrt(len(inside)) + 0.005


@pytest.mark.parametrize("known_errors", [False, True])
def test_peaks_of_equal_size_far_apart_are_all_found(known_errors: bool) -> None:
    """Three narrow peaks make the histogram wide, and the first kernel too."""
    rng = np.random.default_rng(12)
    contrast = np.concatenate([-3.1e-5 * m + 1.6e-4 * rng.standard_normal(48) for m in STANDARDS])
    sigmas = np.full(contrast.shape, 1.6e-4) if known_errors else None
    found = calibrate_mass(contrast, STANDARDS, sigmas=sigmas)
    assert abs(found.gradient_per_kda + 3.1e-5) < 4 * math.sqrt(found.covariance[0, 0])


def test_a_dozen_events_of_each_standard_are_enough() -> None:
    sigma, passed = 2.8e-4, 0
    for seed in range(20):
        rng = np.random.default_rng(80 + seed)
        contrast = np.concatenate(
            [-3.1e-5 * m + sigma * rng.standard_normal(12) for m in STANDARDS]
        )
        try:
            found = calibrate_mass(contrast, STANDARDS, sigmas=np.full(contrast.size, sigma))
        except DataError:
            continue
        passed += 1
        assert found.gradient_per_kda == pytest.approx(-3.1e-5, rel=0.05)
    assert passed >= 17  # 97 % are expected, 19.4 ± 0.8 of 20; with the finer kernels alone 5


def test_landing_and_leaving_weigh_the_same() -> None:
    for gradient in (GRADIENT, -GRADIENT):
        offset = math.copysign(OFFSET, -gradient)
        landing = gradient * 146 + offset
        assert mass_from_contrast(landing, gradient, offset) == pytest.approx(146, rel=1e-12)
        assert mass_from_contrast(-landing, gradient, offset) == pytest.approx(-146, rel=1e-12)
    # The control: a plain line is wrong by 2|o/s| on one branch.
    plain = (-(GRADIENT * 146 + OFFSET) - OFFSET) / GRADIENT
    assert abs(plain + 146) == pytest.approx(2 * abs(OFFSET / GRADIENT), rel=1e-9)
    with pytest.raises(ConfigError, match="nothing about mass"):
        mass_from_contrast(0.1, 0.0)


def test_bright_landing_has_a_positive_gradient() -> None:
    rng = np.random.default_rng(4)
    contrast = events(rng, gradient=-GRADIENT, offset=-OFFSET)
    found = calibrate_mass(contrast, STANDARDS, landing="bright")
    assert abs(found.gradient_per_kda + GRADIENT) < 4 * math.sqrt(found.covariance[0, 0])
    assert "gradient_per_kda = 3" in found.to_toml()


@pytest.mark.parametrize(
    ("standards", "options", "said"),
    [
        ((66, 146, 300), {}, r"66, 146, 300 kDa do not match the peaks .* misses"),
        ((66, 146, 480, 900), {}, "fewer than the 4 standards"),
        ((400, 480), {}, "zero mass would have the contrast"),
        (STANDARDS, {"landing": "bright"}, r"only 60 of 510 events are bright.*wrong sign"),
        ((66.0,), {}, "`standards_kda` = "),
        ((66.0, -146.0), {}, "`standards_kda` = "),
        ((66.0, math.nan), {}, "`standards_kda` = "),
        ((66.0, 66.0), {}, "`standards_kda` = "),
    ],
)
def test_what_cannot_be_is_one_clear_line(
    standards: tuple[float, ...], options: dict[str, Any], said: str
) -> None:
    kind = ConfigError if said.startswith("`") else DataError
    with pytest.raises(kind, match=said):
        calibrate_mass(events(np.random.default_rng(5)), standards, **options)


def test_peaks_may_be_named() -> None:
    """Peaks at 1, 2 and 4 times a mass: those of 132 and 264 kDa lie as those of 66 and 132 do."""
    rng = np.random.default_rng(11)
    contrast = np.concatenate([
        events(rng, (66.0,), count=240, offset=0.0),
        events(rng, (132.0, 264.0), count=60, offset=0.0),
    ])  # fmt: skip
    assert calibrate_mass(contrast, (132, 264)).gradient_per_kda == pytest.approx(
        GRADIENT / 2, rel=0.05
    )  # the control: the more numerous are taken
    for masses in ((132, 264), (264, 132)):
        found = calibrate_mass(contrast, masses, peaks_at=[-GRADIENT * m for m in masses])
        assert found.gradient_per_kda == pytest.approx(GRADIENT, rel=0.03)
    with pytest.raises(DataError, match="264 kDa has no peak of its own near"):
        calibrate_mass(contrast, (132, 264), peaks_at=(-GRADIENT * 132, -GRADIENT * 180))
    with pytest.raises(DataError, match="do not match the peaks"):
        calibrate_mass(contrast, (66, 264), peaks_at=(-GRADIENT * 264, -GRADIENT * 66))
    with pytest.raises(ConfigError, match="one peak for each standard"):
        calibrate_mass(contrast, (132, 264), peaks_at=(0.004,))


def test_few_events_are_refused() -> None:
    with pytest.raises(DataError, match="holds 5 landing events"):
        calibrate_mass([-0.01] * 5, STANDARDS)


def test_two_standards_cannot_test_the_line() -> None:
    found = calibrate_mass(events(np.random.default_rng(8)), (66, 146))
    assert found.dof == 0
    assert any("cannot test it" in note for note in found.notes)


def test_scatter_beyond_the_errors_widens_the_line() -> None:
    rng = np.random.default_rng(9)
    contrast = events(rng, (66.0, 149.0, 480.0))
    tight = [0.01, 0.01, 0.01]
    found = calibrate_mass(contrast, STANDARDS, standards_se_kda=tight)
    assert found.chi2 > 4
    assert any("widened" in note for note in found.notes)


def test_refeyns_masses_are_reproduced_exactly(data_dir: Path) -> None:
    path = data_dir / "refeyn_events_2.4.2.h5"
    if not path.is_file():
        pytest.skip(f"no measured table: {path} is absent")
    table = read_events(path)
    with h5py.File(path) as file:
        gradient, offset = (float(file[f"mass_model/{name}"][()]) for name in ("c_1kDa", "o_0kDa"))
        standards = file["mass_model/contrasts"][:]
    contrast, mass = table["contrast"].to_numpy(), table["mass_kda"].to_numpy()
    assert np.array_equal(mass_from_contrast(contrast, gradient, offset), mass)
    plain = (contrast - offset) / gradient  # the control
    off = np.abs(plain - mass)
    assert np.count_nonzero(off > 1) == np.count_nonzero(contrast > 0) == 641

    found = calibrate_mass(contrast, STANDARDS)
    assert found.gradient_per_kda == pytest.approx(gradient, rel=0.03)
    assert np.allclose(found.standards["contrast"], standards, rtol=0.06)
    assert abs(found.standards["residual_percent"]).max() < 1  # %


@pytest.mark.parametrize(
    ("standards", "fit", "misfit"),
    [
        ((66, 146, 480, 900), "66, 146, 480 kDa would fit", "900 kDa does not"),
        ((66, 146, 300), "66, 146 kDa would fit", "300 kDa does not"),
    ],
)
def test_a_standard_that_is_not_there_is_named(
    standards: tuple[float, ...], fit: str, misfit: str, repetitions: Callable[[int, int], int]
) -> None:
    for seed in range(repetitions(2, 5)):
        with pytest.raises(DataError) as caught:
            calibrate_mass(events(np.random.default_rng(seed)), standards)
        message = str(caught.value)
        assert "|contrast| peaks at 0.0018" in message
        assert fit in message
        assert misfit in message


def test_a_match_is_refused_by_its_chi_square() -> None:
    """The same distance from the line is too much for errors of 1 %, but not for errors of 5 %."""
    contrast = events(np.random.default_rng(10))
    with pytest.raises(DataError, match=r"χ² = .* for 1 degree of freedom"):
        calibrate_mass(contrast, (66, 146, 420), standards_se_kda=(0.66, 1.46, 4.2))
    assert calibrate_mass(contrast, (66, 146, 420), standards_se_kda=(3.3, 7.3, 21.0)).dof == 1


@pytest.mark.parametrize(
    ("contrasts", "masses", "said"),
    [
        (1.0, 1e3, r"66000,146000,480000 seem to be in Da; give them in kDa"),
        (1.0, 1e-3, r"0\.066,0\.146,0\.48 seem to be in MDa; give them in kDa"),
        (100.0, 1.0, r"contrasts, of up to 1\.\d+, seem to be in per cent; divide them by 100"),
    ],
    ids=["Da", "MDa", "per cent"],
)
def test_numbers_in_other_units_are_named(contrasts: float, masses: float, said: str) -> None:
    found = events(np.random.default_rng(11))
    calibrate_mass(found, STANDARDS)
    calibrate_mass(10 * found, STANDARDS)  # as behind a mask that dims the reference
    with pytest.raises(DataError, match=said):
        calibrate_mass(contrasts * found, [masses * mass for mass in STANDARDS])


@pytest.mark.parametrize("mark", [";", "\t"])
def test_tables_of_other_spreadsheets_are_read(mark: str, tmp_path: Path) -> None:
    contrast = events(np.random.default_rng(11))
    mass = contrast / GRADIENT
    theirs = pd.DataFrame({"masses_kDa": mass, "contrasts": contrast})
    ours = pd.DataFrame({"event": 0, "mass_kda": mass, "contrast": contrast, "status": "ok"})
    ours["sigma_mass_kda"] = 8.5
    for table in (theirs, ours):
        table.to_csv(tmp_path / "plain.csv", index=False)
        table.to_csv(tmp_path / "other.csv", index=False, sep=mark, decimal=",")
        plain, other = (read_contrasts(tmp_path / f"{name}.csv") for name in ("plain", "other"))
        pd.testing.assert_frame_equal(plain, other)
    plain, other = (event_table(tmp_path / f"{name}.csv") for name in ("plain", "other"))
    assert np.array_equal(plain.mass_kda, other.mass_kda)
    assert len(other.mass_kda)


def test_the_error_of_the_line_is_keys_that_are_read_back() -> None:
    found = calibrate_mass(events(np.random.default_rng(11)), STANDARDS)
    config = parse_config(tomllib.loads(found.to_toml()))
    line = config.calibration
    assert line is not None
    assert line.gradient_se_per_kda == pytest.approx(math.sqrt(found.covariance[0, 0]), rel=1e-3)
    table = pd.DataFrame({"mass_kda": [66.0, -146.0, 300.0, 900.0], "flags": ""})
    shared = systematic(config, table)["mass_kda"]
    contrast = found.gradient_per_kda * 300 + found.offset
    assert shared[2] == pytest.approx(found.sigma_kda(contrast), rel=2e-3)
    # Repetitions of the whole line scatter as it says, between the standards and beyond.
    rng = np.random.default_rng(12)
    lines = rng.multivariate_normal([found.gradient_per_kda, found.offset], found.covariance, 4000)
    for mass, sigma in zip(table["mass_kda"].abs(), shared, strict=True):
        size = found.gradient_per_kda * mass + found.offset
        masses = (size - lines[:, 1]) / lines[:, 0]
        assert masses.std() == pytest.approx(sigma, rel=0.06)  # 4 standard errors of 4000, and more
    assert not systematic(configure(), table)


def test_the_error_of_the_scale_widens_the_intervals_of_species() -> None:
    rng = np.random.default_rng(13)
    mass, sigma = 480 + 20 * rng.standard_normal(200), np.full(200, 20.0)
    plain = describe(mass, sigma, seed=1, choice=Searched(1), draws=40).species.iloc[0]
    wider = describe(
        mass, sigma, seed=1, choice=Searched(1), draws=40, scale_error=lambda m: 0.015 * m
    ).species.iloc[0]
    assert plain["mass_systematic"] == 0
    assert wider["mass_systematic"] == pytest.approx(0.015 * plain["mass_kda"])
    assert wider["mass_se"] == plain["mass_se"]
    half = (wider["mass_high"] - wider["mass_low"]) / 2
    statistical = (plain["mass_high"] - plain["mass_low"]) / 2
    assert half == pytest.approx(math.hypot(statistical, 1.96 * 0.015 * 480), rel=0.05)
