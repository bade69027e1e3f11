"""The spread that is measured: on parts of an event's frames, and where there is no particle."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from report_factory import make_analysis
from scenes import PIXEL_NM, make_config
from scipy.stats import norm

from iscat_analysis.findings.optics import LESS_NOISE, SCALED_SIGMA, UNDERSTATED_SIGMA
from iscat_analysis.inference import counts as noise
from iscat_analysis.inference.fit import fit_particle
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.inference.repeats import (
    LENGTHS,
    PARTS,
    EmpiricalSpread,
    Series,
    pooled,
    repeats_of,
    response_of,
    series_of,
)
from iscat_analysis.landing.split_frames import most_windows
from iscat_analysis.optics.forward import PixelGrid, forward_model
from iscat_analysis.pipeline.finish import species_of
from iscat_analysis.records import FREE_PARAMETERS, Candidate
from iscat_analysis.report import render_report
from iscat_analysis.report.answer import rejection, species_widths
from iscat_analysis.search.empty import CONTRASTS, EmptyField
from iscat_analysis.species.tables import event_table as events_of
from iscat_analysis.trust.checks import likely_noise, measured_scale, spread_verdict

SIGMAS = 4.0
GRID = PixelGrid.region((0, 32), (0, 32), PIXEL_NM)
START = Candidate(15.3, 16.8, 5.0, 1000.0, 10.0)
LIGHT_E = 1e4
FRAMES = 40


def _frames(rng: np.random.Generator, mode: str = "mass") -> tuple[np.ndarray, np.ndarray]:
    """Draw frames before and after a particle lands."""
    focus = {"optics": {"focus_nm": -500.0}} if mode == "joint" else {}
    model = forward_model(make_config(**focus), 4000.0)
    signal = model.image(GRID, 15.3 * PIXEL_NM, 16.8 * PIXEL_NM, 5.0, 1000.0)
    shape = (FRAMES, *GRID.shape)
    return rng.poisson(LIGHT_E, shape), rng.poisson(LIGHT_E * (1 + signal), shape)


def _likelihood(before: np.ndarray, after: np.ndarray, mode: str = "mass") -> Likelihood:
    focus = {"optics": {"focus_nm": -500.0}} if mode == "joint" else {}
    model = forward_model(make_config(**focus), 4000.0)
    sums = (frames.sum(axis=0).astype(float) for frames in (before, after))
    return noise.conditional(model, GRID, *sums, len(after) / len(before))


@pytest.mark.parametrize("mode", ["mass", "joint"])
def test_a_part_weighed_once_is_the_part_refitted(mode: str) -> None:
    """To first order: halves differ by √2 · 2 σ, and what is left is second order, 1/SNR."""
    rng = np.random.default_rng(1)
    z_range = (0.0, 100.0)
    apart, linear = [], []
    for _ in range(12):
        before, after = _frames(rng, mode)
        whole = _likelihood(before, after, mode)
        fit = fit_particle(whole, START, mode, z_range, level=False)
        sums = before.sum(axis=0).astype(float)
        response = response_of(whole, fit.theta, fit.box.free, sums, 1.0)
        assert response is not None
        refits = [
            fit_particle(
                _likelihood(before[k::2], after[k::2], mode), START, mode, z_range, level=False,
                correct_bias=False,
            ).theta[fit.box.free]
            for k in (0, 1)
        ]  # fmt: skip
        apart.append((refits[1] - refits[0]) / np.sqrt(response.variance))
        change = [
            np.einsum("iyx,yx->i", weights, (frames[1::2] - frames[0::2]).sum(axis=0).astype(float))
            for weights, frames in ((response.before, before), (response.after, after))
        ]
        linear.append(2 * sum(change) / np.sqrt(response.variance))
    missed = np.sqrt(np.mean((np.array(apart) - linear) ** 2, axis=0))
    assert np.all(missed < 0.1 * np.sqrt(np.mean(np.square(apart), axis=0)))


def test_the_response_has_the_variance_of_the_bound() -> None:
    rng = np.random.default_rng(2)
    before, after = _frames(rng)
    whole = _likelihood(before, after)
    fit = fit_particle(whole, START, "mass", (0.0, 1000.0), level=False)
    response = response_of(whole, fit.theta, fit.box.free, before.sum(axis=0).astype(float), 1.0)
    assert response is not None
    variance = np.einsum("iyx,yx->i", response.before**2, before.sum(axis=0))
    variance += np.einsum("iyx,yx->i", response.after**2, after.sum(axis=0))
    # Σ counts against their expectation: 1 % of 40 000 photoelectrons per pixel is 2 σ
    np.testing.assert_allclose(variance, response.variance, rtol=0.01)


@pytest.mark.parametrize("factor", [1.0, 1.5])
def test_squares_come_to_their_number_times_the_excess(factor: float) -> None:
    rng = np.random.default_rng(3)
    power = rng.uniform(0.8, 1.2, 320)
    shot, read = np.array([3.0, 0.5]), np.array([1.0, 0.2])
    spread = np.sqrt(factor * (shot[:, None] * power + read[:, None]))
    found = np.zeros_like(repeats_of((Series(np.zeros((2, 0)), np.zeros(0), shot, read),)))
    for _ in range(300):
        values = 7.0 * power + spread * rng.standard_normal((2, power.size))
        found += repeats_of((Series(values, power, shot, read),))
    counts = found[:, 2]
    used = counts > 0
    mean = found[used, :2] / counts[used, None]
    assert counts[0] == 300 * (PARTS - 1)
    assert np.all(np.abs(mean - factor) < SIGMAS * factor * np.sqrt(2 / counts[used, None]))


def test_parts_of_one_window_do_not_see_the_step_but_see_a_drift() -> None:
    power, one = np.ones(80), np.array([1.0])
    still = Series(np.full((1, 80), 5.0), power, one, 0 * one)
    assert repeats_of((still,))[0, 0] == pytest.approx(0)
    slope = 0.01
    moving = Series(slope * np.arange(80.0)[None], power, one, 0 * one)
    for length in (1, 10, 40):
        squares, pairs = repeats_of((moving,))[1 + LENGTHS.index(length)]
        # the means of neighbouring parts are slope·n apart, their variance is 1/n each
        assert squares / pairs == pytest.approx((slope * length) ** 2 * length / 2)


def test_frames_that_are_left_out_do_not_count() -> None:
    rng = np.random.default_rng(4)
    counts = rng.integers(90, 110, (20, 3, 3)).astype(np.uint16)
    power = np.ones(20)
    power[[3, 7]] = 0.0
    counts[[3, 7]] = 60_000
    series = series_of(
        counts, np.ones((2, 3, 3)), power,
        gain=2.0, offset=5.0, mean_e=np.full((3, 3), 190.0), read_variance_e2=np.zeros((3, 3)),
    )  # fmt: skip
    assert series.power.size == 18
    expected = 2.0 * (counts[0].sum() - 9 * 5.0)
    assert series.values[0, 0] == pytest.approx(expected)


# ---- where there is no particle ----------------------------------------------------------------


def _empty(shape: tuple[int, int] = (96, 96), level: bool = True) -> tuple[EmptyField, int]:
    model = forward_model(make_config(), 4000.0)
    grid = PixelGrid.centred(33, PIXEL_NM)
    _, first = model.signal(grid, (0.0, 0.0, 5.0, 1000.0))
    slopes = first[[0, 1, 3]]
    if level:
        slopes = np.concatenate([slopes, np.ones((1, 33, 33))])
    return EmptyField(
        np.full(shape, LIGHT_E), np.full(shape, 400.0), np.ones(shape, dtype=bool), slopes, 3,
        additive=False, spacing_px=2, tile_px=16,
    ), 3  # fmt: skip


def _levels(field: EmptyField, images: np.ndarray) -> np.ndarray:
    """Mean squares of the contrasts, shape (contrasts, n), of 16 parts of 5 frames."""
    parts = [field.errors(image, 5.0, None) for image in images]
    five = np.full(8, 5.0)
    taken = np.zeros((96, 96), dtype=bool)
    found = field.spread(parts[:8], parts[8:], (five, five), taken)
    return found.squares.sum(axis=2) / found.counts.sum(axis=1)[:, None]


@pytest.mark.parametrize("excess", [1.0, 1.5])
def test_empty_places_have_the_variance_of_the_noise(excess: float) -> None:
    """Some 900 independent places: the squared spread to 5 %."""
    field, _ = _empty()
    rng = np.random.default_rng(5)
    spread = np.sqrt(excess * 5 * (LIGHT_E + 400.0))
    images = 5 * LIGHT_E + spread * rng.standard_normal((16, 96, 96))
    np.testing.assert_allclose(_levels(field, images), excess, rtol=0.2)


def test_a_drift_shows_in_whole_windows_and_hardly_in_their_parts() -> None:
    """At constant speed the step is 8/4 as long as between halves: a variance eight times."""
    field, _ = _empty()
    rng = np.random.default_rng(6)
    pattern = rng.standard_normal((96, 96))
    images = 5 * LIGHT_E * (1 + 1e-3 * np.arange(16)[:, None, None] * pattern)
    whole, _, _, _, halves = _levels(field, images)
    np.testing.assert_allclose(whole / halves, 8.0, rtol=0.02)
    assert CONTRASTS[0] == "whole"
    assert CONTRASTS[-1] == "halves"


def test_a_known_particle_is_no_noise_and_a_taken_place_is_not_looked_at() -> None:
    field, _ = _empty()
    images = np.full((16, 96, 96), 5 * LIGHT_E)
    bump = np.zeros((96, 96))
    bump[40:44, 40:44] = 300.0
    images[8:] += 5 * bump
    parts = [field.errors(image, 5.0, bump if k >= 8 else None) for k, image in enumerate(images)]
    five = np.full(8, 5.0)
    everywhere = np.ones((96, 96), dtype=bool)
    assert not field.spread(parts[:8], parts[8:], (five, five), everywhere).counts.any()
    assert np.abs(np.stack(parts[8:]) - np.stack(parts[:8])).max() < 1e-9


# ---- pooling -----------------------------------------------------------------------------------


def _own(rng: np.random.Generator, events: int, variance: float) -> np.ndarray:
    own = np.zeros((events, 1 + len(LENGTHS), 2))
    own[:, :, 1] = 14
    own[:, :, 0] = variance * rng.chisquare(14, (events, 1 + len(LENGTHS)))
    return own


def _nothing_there(rng: np.random.Generator, whole: float, parts: float) -> tuple[np.ndarray, ...]:
    counts = np.full((len(CONTRASTS), 64), 20.0)
    squares = parts * rng.chisquare(20, counts.shape)
    squares[0] = whole * rng.chisquare(20, 64)
    return squares, counts


@pytest.mark.parametrize(("own", "parts", "whole"), [(1, 1, 1), (1.5, 1.5, 1.5), (1.2, 1, 4)])
def test_the_interval_holds_the_truth_as_often_as_it_says(own, parts, whole) -> None:
    """Of 400 movies 95 % do, ± 1.1 %."""
    rng = np.random.default_rng(7)
    truth = np.sqrt(whole + own - parts)
    held, ratio = 0, []
    for _ in range(400):
        found = pooled(_own(rng, 40, own), *_nothing_there(rng, whole, parts))
        assert found is not None
        held += found.ci95[0] < truth < found.ci95[1]
        ratio.append(found.over_crb)
    assert abs(held / 400 - 0.95) < SIGMAS * 0.011
    assert np.mean(ratio) == pytest.approx(truth, rel=0.01)


def test_without_empty_places_slow_noise_is_missed_and_the_result_says_so() -> None:
    """The control: own frames alone call a movie clean whose errors are twice the bound."""
    rng = np.random.default_rng(8)
    own = _own(rng, 200, 1.0)
    alone = pooled(own, None, None)
    both = pooled(own, *_nothing_there(rng, 4.0, 1.0))
    assert alone is not None
    assert both is not None
    assert not alone.whole
    assert not alone.exceeds
    assert alone.over_crb == pytest.approx(1.0, abs=0.06)
    assert both.exceeds
    assert both.over_crb == pytest.approx(2.0, rel=0.05)


def test_no_event_has_no_spread() -> None:
    assert pooled(np.zeros((0, 1 + len(LENGTHS), 2)), None, None) is None
    assert pooled(np.zeros((3, 1 + len(LENGTHS), 2)), None, None) is None


# ---- verdict -----------------------------------------------------------------------------------


def _achieved(
    ratio: float, single: float = 1.0, empty: tuple[float, ...] = (1.0,) * 5
) -> EmpiricalSpread:
    return EmpiricalSpread(
        ratio, (ratio - 0.03, ratio + 0.03), 100, bool(empty), (ratio - 1) / 0.015,
        (1, 10), (single, single), (0.01, 0.03), empty,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("found", "pixels", "word"),
    [
        (_achieved(1.22, 1.22, (1.22,) * 5), 1.5, "gain_e_per_adu"),
        (_achieved(1.22, 1.22, (1.22,) * 5), 1.0, "neighbouring pixels"),
        (_achieved(1.31, 1.0, (1.08, 1.05, 1.09, 1.16, 1.31)), 1.0, "flicker"),
        (_achieved(1.80, 1.0, (1.03, 1.0, 1.02, 1.14, 1.80)), 1.0, "drift"),
        (_achieved(1.50, 1.0, (1.0,) * 5), 1.0, "at the particles"),
    ],
)
def test_the_noise_is_named(found: EmpiricalSpread, pixels: float, word: str) -> None:
    assert word in likely_noise(found, {"noise_variance_over_shot": [pixels]})
    verdict, said = spread_verdict({"mass_kda": found}, {}, scaled=False)
    assert said is not None
    assert said.kind is UNDERSTATED_SIGMA
    assert verdict["understated"]
    assert f"{found.over_crb:.2f} (" in verdict["message"]
    assert "wrong model" not in verdict["message"]
    scaled, said = spread_verdict({"mass_kda": found}, {}, scaled=True)
    assert not scaled["understated"]
    assert said is not None
    assert said.kind is SCALED_SIGMA


def test_what_slow_noise_may_be_and_what_helps_depend_on_the_model_and_on_the_frames() -> None:
    drifting = _achieved(1.80, 1.0, (1.03, 1.0, 1.02, 1.14, 1.80))
    white = _achieved(1.22, 1.22, (1.22,) * 5)
    assert "wrong model" in likely_noise(drifting, {}, rejected=True)  # it may be its rings
    assert "wrong model" not in likely_noise(white, {}, rejected=True)
    assert "drift_correction" in likely_noise(drifting, {}, sliding=True)
    fixed = likely_noise(drifting, {}, sliding=False)
    assert "drift_correction" not in fixed
    assert "nearer to the others (background.frames)" in fixed


def test_a_clean_movie_is_told_nothing() -> None:
    assert spread_verdict({"mass_kda": _achieved(1.01)}, {}, scaled=False)[1] is None
    less, said = spread_verdict({"mass_kda": _achieved(0.85)}, {}, scaled=False)
    assert not less["understated"]
    assert said is not None
    assert said.kind is LESS_NOISE


def test_sigma_is_scaled_up_and_never_down() -> None:
    found = {"x_nm": _achieved(1.5), "mass_kda": _achieved(0.8)}
    assert measured_scale(found) == {"sigma_x_nm": 1.5, "sigma_mass_kda": 1.0}


# ---- the report --------------------------------------------------------------------------------


def _measured(ratio: float, message: str = ""):
    analysis = make_analysis(40)
    summary = dict(analysis.summary)
    precision = {
        name: {
            **summary.get("precision", {}).get(name, {}),
            "repeat_over_crb": ratio,
            "repeat_over_crb_ci95": [ratio - 0.05, ratio + 0.05],
            "repeat_significance": (ratio - 1) / 0.025,
            "repeat_events": 40,
            "repeat_whole": True,
            "repeat_frames": [1, 10],
            "repeat_over_crb_by_frames": [1.0, ratio],
            "repeat_over_crb_by_frames_se": [0.01, 0.05],
            "empty_over_crb": [1.0, 1.0, 1.0, 1.0, ratio],
        }
        for name in FREE_PARAMETERS[analysis.mode]
    }  # fmt: skip
    summary |= {
        "precision": precision,
        "repeats": {"understated": bool(message), "message": message, "cause": ""},
    }
    return replace(analysis, summary=summary)


def test_the_page_shows_what_was_measured() -> None:
    page = render_report(_measured(1.02))
    assert "Errors are right: the measured spread is 1.02 (0.97 to 1.07) times the bound" in page
    assert 'data-figure="spread"' in page
    assert "Errors are right" not in render_report(make_analysis(40))


def test_understated_errors_are_never_shown_without_the_line() -> None:
    found = UNDERSTATED_SIGMA({"ratios": "1.40", "cause": "its kind is not told"})
    analysis = replace(_measured(1.4, found.text), findings=(found,))
    flagged = analysis.table.assign(status="poor_fit", flags="poor_fit")
    for one in (analysis, replace(analysis, table=flagged)):
        first = re.search(r'<ul class="trust".*?</ul>', render_report(one), re.DOTALL)
        assert first is not None
        assert "σ is too small: the measured spread is 1.40 times the Cramér–Rao bound" in first[0]
        assert "Errors are right" not in first[0]


def test_a_rejected_model_is_named_where_the_spread_is() -> None:
    rng = np.random.default_rng(9)
    table = make_analysis(300).table
    fair = table.assign(p_value=rng.uniform(size=300))
    assert rejection(fair) is None
    poor = fair.assign(p_value=np.where(np.arange(300) < 30, 1e-6, fair["p_value"]))
    found = rejection(poor)
    assert found is not None
    assert found.code == "model-rejected"
    assert 30 <= found.values["poor"] < 40
    analysis = _measured(1.0)
    table = analysis.table.assign(p_value=1e-9)
    page = render_report(replace(analysis, table=table))
    assert "The model is rejected" in page
    assert "the measured spread is 1.00" in page


def test_the_model_of_moving_particles_is_rejected_by_most_tracks_and_not_by_two() -> None:
    rng = np.random.default_rng(2)
    p, track = rng.uniform(size=3000), np.repeat(np.arange(15), 200)
    table = pd.DataFrame({"p_value": p, "track": track, "status": "ok"})
    assert rejection(table) is None
    disturbed = table.assign(p_value=np.where(track < 2, p**4, p))  # as by one out of the field
    assert rejection(disturbed) is None
    assert rejection(disturbed.drop(columns="track")) is not None
    everywhere = table.assign(p_value=p**1.5)
    assert rejection(everywhere) is not None
    alone = disturbed[track == 0]
    assert rejection(alone) is not None


def test_the_width_of_a_species_is_told_with_its_interval() -> None:
    one = {"mass_kda": 66.0, "width_kda": 3.14, "width_low": 2.5, "width_high": 3.7, "count": 120}
    found = {"across_particles": [one | {"spread_over_sigma": 1.25}], "mass_scale": "calibration"}
    (line,) = species_widths(found)
    assert "at 66.0 kDa is 3.14 kDa (2.50 to 3.70) wide" in line
    assert "1.25 times σ" in line
    (line,) = species_widths(found | {"mass_scale": "absolute model"})
    assert "is 4.76 % (3.79 to 5.61) wide" in line
    assert species_widths({}) == []


def test_species_of_poor_fits_are_judged_where_the_model_is_rejected(tmp_path: Path) -> None:
    """Masses scatter by 5 % beyond σ = 2 kDa: the page says so though every fit is poor."""
    rng = np.random.default_rng(10)
    table = make_analysis(120).table
    mass = 150.0 + np.hypot(7.5, 2.0) * norm.ppf((np.arange(120) + 0.5) / 120)
    poor = {"status": "poor_fit", "flags": "poor_fit", "p_value": 1e-9}
    table = table.assign(mass_kda=mass, sigma_mass_kda=2.0, **poor)
    context: Any = SimpleNamespace(
        config=SimpleNamespace(compute=SimpleNamespace(seed=1), fits_sizes=False),
        templates=SimpleNamespace(threshold=5.0), mode="mass",
    )  # fmt: skip
    found = species_of(context, table)
    (one,), (species,) = found["across_particles"], found["distribution"]["species"]
    assert (one["mass_kda"], one["count"]) == (species["mass_kda"], species["count"])
    assert species["count"] == pytest.approx(120)
    assert "poor fits are counted too" in found["distribution"]["notes"][-1]
    table.to_csv(tmp_path / "fits.csv")
    listed = events_of(tmp_path / "fits.csv")  # as `iscat species` and `iscat kd` read it
    assert listed.mass_kda.size == 120
    assert any("poor fits are counted too" in finding.text for finding in listed.findings)
    assert one["width_low"] < 7.5 < one["width_high"]
    assert one["spread_over_sigma"] == pytest.approx(np.hypot(1, 7.5 / 2), rel=0.2)
    fair = table.assign(status="ok", flags="", p_value=rng.uniform(size=120))
    fair.loc[fair.index[:6], "status"] = "poor_fit"
    found = species_of(context, fair)
    fair.to_csv(tmp_path / "fits.csv")
    assert events_of(tmp_path / "fits.csv").mass_kda.size == 114
    assert found["distribution"]["events"] == 114
    assert not any("poor fits" in note for note in found["distribution"]["notes"])


def test_a_long_movie_is_looked_at_in_as_many_windows_as_tell_its_noise() -> None:
    assert most_windows(4000, 1.0) == 5  # of one chunk
    assert most_windows(4000, 0.25) == 5
    assert most_windows(100, 1.0) == 8
    for chunks in (20, 100):  # every chunk has two all the same
        assert most_windows(4000, 1 / chunks) == 2
