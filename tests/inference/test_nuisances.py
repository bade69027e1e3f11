"""Heights, widths and fluctuations that a fit takes for known are seen beside it, and judged."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.signal import lfilter

from iscat_analysis.config import OpticsCovariance, config_to_toml, load_config
from iscat_analysis.findings.optics import LONG_IMAGES
from iscat_analysis.inference.counts import conditional
from iscat_analysis.inference.fit import fit_particle
from iscat_analysis.inference.heights import spread_of_heights
from iscat_analysis.inference.nuisances import Evidence, evidence_of
from iscat_analysis.inference.repeats import BLOCK_ROWS, EmpiricalSpread, Series, pooled, repeats_of
from iscat_analysis.optics.forward import ForwardModel, PixelGrid, forward_model
from iscat_analysis.records import Candidate, FloatArray
from iscat_analysis.search.dating import StepFrame, common_rise, go_on_rising, locate_step
from iscat_analysis.search.frames import Patch
from iscat_analysis.trust.changing_light import Fluctuation, at_a_shared_place, in_parts, may_rise
from iscat_analysis.trust.extension import Extension
from iscat_analysis.trust.response import response_of

MASS_KDA, LIGHT_E, TRIALS, SIGMAS = 205.0, 8e6, 40, 4.0
GRID = PixelGrid.centred(33, 84.0)
SETTINGS = (
    "camera.pixel_size_nm=84", "optics.na=1.42", "optics.focus_nm=-300", "optics.attenuation=1",
    "calibration.gradient_per_kda=-3.1e-5", "particle.height_nm=5",
)  # fmt: skip
CONFIG = load_config(None, list(SETTINGS))


@cache
def model(*settings: str) -> ForwardModel:
    return forward_model(load_config(None, [*SETTINGS, *settings]), 4000.0)


def seen(*, z_nm: float = 5.0, wiggle_nm: float = 0.0, apart_nm: float = 0.0) -> tuple:
    """Fit points at 5 nm to particles that are something else; their masses and the evidence."""
    rng, told, masses = np.random.default_rng(3), [], []
    shown = model(f"particle.wiggle_nm={wiggle_nm}") if wiggle_nm else model()
    for _ in range(TRIALS):
        x, y, angle = *rng.uniform(-40, 40, 2), rng.uniform(0, math.pi)
        dx, dy = apart_nm / 2 * math.cos(angle), apart_nm / 2 * math.sin(angle)
        signal = sum(
            shown.image(GRID, x + side * dx, y + side * dy, z_nm, MASS_KDA / 2) for side in (-1, 1)
        )
        before, after = rng.poisson(LIGHT_E, GRID.shape), rng.poisson(LIGHT_E * (1 + signal))
        likelihood = conditional(
            model(), GRID, before.astype(float), after.astype(float), np.ones(GRID.shape)
        )
        start = Candidate(0.0, 0.0, 5.0, MASS_KDA, 50.0)
        fit = fit_particle(likelihood, start, "mass", (0.0, 1000.0), level=True)
        masses.append(fit.mass_kda)
        told.append(evidence_of(likelihood, fit))
    return np.array(masses), Evidence(*np.array(told).T)


def rows(number: int, *, sigma_kda: float = 3.0) -> pd.DataFrame:
    return pd.DataFrame({
        "status": "ok", "flags": "", "n_before": 80, "n_after": 80, "mass_kda": MASS_KDA,
        "sigma_mass_kda": sigma_kda, "crb_mass_kda": sigma_kda, "crb_x_nm": 2.0, "crb_y_nm": 2.0,
    }, index=range(number))  # fmt: skip


# ---- evidence of one event -------------------------------------------------------------------


def test_points_at_their_height_show_nothing() -> None:
    _, told = seen()
    for pull in (
        (told.z_nm - 5) / told.sigma_z_nm,
        told.spread_nm2 / told.sigma_spread_nm2,
        told.across_nm2 / told.sigma_across_nm2,
        told.along_nm2 / told.sigma_across_nm2,
    ):
        assert abs(pull.mean()) < SIGMAS / TRIALS**0.5
        assert abs(pull.std() - 1) < SIGMAS / (2 * TRIALS) ** 0.5
    assert abs(told.chi2_spread.mean() - 3) < SIGMAS * (6 / TRIALS) ** 0.5
    assert not Extension.of(CONFIG, rows(TRIALS), told, {}).flagged.any()
    heights = spread_of_heights(told.z_nm, told.sigma_z_nm)
    assert heights is not None
    assert not heights.is_spread


def test_a_height_that_is_not_held_is_told_and_what_the_mass_loses() -> None:
    masses, told = seen(z_nm=7.0)
    assert abs(told.z_nm.mean() - 7) < SIGMAS * told.sigma_z_nm.mean() / TRIALS**0.5 + 0.3
    # the fit of the height makes up for what the wrong one took; second order is a tenth of it
    shift = told.mass_per_z.mean() * 2
    assert abs(shift) < 3 * (MASS_KDA - masses.mean())


def test_a_wiggle_is_as_wide_as_the_model_has_it() -> None:
    masses, told = seen(wiggle_nm=35.0)
    error = told.sigma_spread_nm2.mean() / TRIALS**0.5
    assert abs(told.spread_nm2.mean() - 35.0**2) < SIGMAS * error
    assert masses.mean() < 0.93 * MASS_KDA
    mended = masses + told.mass_per_spread * 35.0**2
    assert abs(mended.mean() / MASS_KDA - 1) < 0.03


FOCUS_LEARNED = OpticsCovariance(names=("focus_nm",), matrix=((1.0,),))


def best_focus(shown: FloatArray) -> tuple[float, float, float]:
    """Amplitude of a point at −300 nm, shift of the focus that suits best, and amplitude there."""
    step, found = 2.0, []
    for focus in (-300 - step, -300, -300 + step):
        likelihood = conditional(
            model(f"optics.focus_nm={focus}"), GRID, np.full(GRID.shape, LIGHT_E),
            LIGHT_E * (1 + shown), np.ones(GRID.shape),
        )  # fmt: skip
        start = Candidate(0.0, 0.0, 5.0, MASS_KDA, 50.0)
        fit = fit_particle(likelihood, start, "mass", (0.0, 1000.0), level=True, correct_bias=False)
        found.append((fit.log_likelihood, fit.theta[3]))
    (low, below), (middle, held), (high, above) = found
    moved = 0.5 * (low - high) / (low - 2 * middle + high)
    followed = held + moved * (above - below) / 2 + moved**2 * (below - 2 * held + above) / 2
    return held, step * moved, followed


def test_a_learned_focus_takes_a_part_of_a_width() -> None:
    variance = 100.0
    wide, point = (
        best_focus(shown.image(GRID, 0.0, 0.0, 5.0, MASS_KDA))
        for shown in (model("particle.wiggle_nm=10"), model())
    )
    config = load_config(None, [*SETTINGS, "background.method=sliding"])
    learned = config.optics.model_copy(update={"covariance": FOCUS_LEARNED})
    amplitude = model().scale.amplitude(MASS_KDA)
    with_learned = config.model_copy(update={"optics": learned})
    shifts = response_of(with_learned, rows(4)).to_width(amplitude)
    alone = response_of(config, rows(4)).to_width(amplitude)
    assert alone.left == 1
    assert 0 < shifts.left < 1
    assert (wide[0] / point[0] - 1) / variance == pytest.approx(alone.amplitude, rel=0.05)
    assert (wide[1] - point[1]) / variance == pytest.approx(shifts.optics[0], rel=0.05)
    assert (wide[2] / point[2] - 1) / variance == pytest.approx(shifts.amplitude, rel=0.05)


def test_learned_optics_take_their_part_of_a_width_in_a_later_run_too(tmp_path: Path) -> None:
    """The table of an analysis with its own ``config.toml`` had a smaller error.

    Control: optics of a file were learned from other particles.
    """
    optics = CONFIG.optics.model_copy(update={"covariance": FOCUS_LEARNED, "calibrate": "never"})
    learned = CONFIG.model_copy(update={"optics": optics})
    path = tmp_path / "config.toml"
    path.write_text(config_to_toml(learned), encoding="utf-8")
    told = of_many(np.full(40, 100.0), 100.0, np.zeros(40), np.zeros(40))
    file = optics.model_copy(update={"file": "optics.toml"})
    first, again, other, alone = (
        Extension.of(config, rows(40), told, {})
        for config in (
            learned, load_config(path), CONFIG.model_copy(update={"optics": file}), CONFIG,
        )
    )  # fmt: skip
    np.testing.assert_array_equal(first.mass_shift_kda, again.mass_shift_kda)
    assert first.variance_se_nm2 > 1.1 * alone.variance_se_nm2
    np.testing.assert_array_equal(other.mass_shift_kda, alone.mass_shift_kda)


@pytest.mark.parametrize("apart_nm", [100.0, 200.0])
def test_particles_in_two_halves_are_flagged(apart_nm: float) -> None:
    masses, told = seen(apart_nm=apart_nm)
    assert masses.mean() < 0.95 * MASS_KDA
    judged = Extension.of(CONFIG, rows(TRIALS), told, {})
    assert judged.flagged.all()
    assert judged.finding.kind is LONG_IMAGES
    # optics cannot elongate images so
    assert "optics" in replace(judged, is_long=False).finding.text


# ---- heights of many -------------------------------------------------------------------------


@pytest.mark.parametrize(("mean", "sd"), [(11.0, 6.0), (5.0, 1.0), (30.0, 15.0)])
def test_mean_and_spread_of_heights_are_found_behind_the_errors(mean: float, sd: float) -> None:
    rng = np.random.default_rng(8)
    inside = 0
    for _ in range(40):
        sigma = rng.uniform(0.5, 4.0, 60)
        z = rng.normal(mean, sd, 60) + sigma * rng.normal(size=60)
        found = spread_of_heights(z, sigma)
        assert abs(found.mean_nm - mean) < 4.5 * found.mean_se_nm
        inside += found.sd_low_nm <= sd <= found.sd_high_nm
    assert inside >= 33  # 95 % of 40 are 38; fewer than 33 come once in 2000


def test_equal_heights_are_not_spread() -> None:
    rng = np.random.default_rng(9)
    for _ in range(50):
        sigma = rng.uniform(0.5, 4.0, 60)
        assert not spread_of_heights(5 + sigma * rng.normal(size=60), sigma).is_spread


# ---- places that wiggle from frame to frame ----------------------------------------------------


def of_many(
    width_nm2: FloatArray, se_nm2: float, across_nm2: FloatArray, along_nm2: FloatArray
) -> Evidence:
    """Evidence of events whose widths and lengths are given, the latter ±100 nm²."""
    one = np.ones(len(width_nm2))
    return Evidence(
        5.0 * one, 0.5 * one, one, width_nm2, se_nm2 * one, 0.015 * one, 3.0 * one,
        across_nm2, along_nm2, 100.0 * one, 0.0 * one,
    )  # fmt: skip


def in_time(moved_nm2: float) -> dict[str, EmpiricalSpread]:
    """Measured spread of particles that move so much from frame to frame, ±14 nm²."""
    excess = moved_nm2 / (2 * ONE_FRAME_NM2)
    return dict.fromkeys(("x_nm", "y_nm"), EmpiricalSpread(
        1.0, (0.9, 1.1), 40, True, 0.0, (1.0, 2.0),
        (math.sqrt(max(1 + excess, 0.0)), 1.0), (0.03, 0.03), (1.0, 1.0, 1.0),
    ))  # fmt: skip


ONE_FRAME_NM2 = 4.0 * 40  # variance of the place in a single frame of `rows`


def test_positions_that_scatter_from_frame_to_frame_are_a_wiggle() -> None:
    none, moved = np.zeros(40), in_time(15.0**2)
    told = of_many(none, 1000.0, none, none)
    found = Extension.of(CONFIG, rows(40), told, moved)
    width_se = 1000.0 / math.sqrt(40)
    assert 15.0**2 < found.mean_nm2 < 15.0**2 + width_se  # no less than it wiggles
    assert found.flagged.all()
    wide = of_many(np.full(40, 35.0**2), 1.0, none, none)
    within = Extension.of(CONFIG, rows(40), wide, moved)  # most of it is within a frame
    assert within.mean_nm2 == pytest.approx(35.0**2, rel=1e-3)
    known = load_config(None, [*SETTINGS, "particle.wiggle_nm=15"])
    assert not Extension.of(known, rows(40), told, moved).flagged.any()  # the model has it
    assert not Extension.of(CONFIG, rows(40), told, in_time(0.0)).flagged.any()


@pytest.mark.parametrize("bright", [1, 2])
def test_a_few_bright_wide_particles_do_not_make_all_particles_wide(bright: int) -> None:
    """Their errors are thirty times smaller than those of forty proteins, which are points."""
    rng = np.random.default_rng(14)
    events = 40 + bright
    wide = np.arange(events) >= 40
    width, across, along = np.where(wide, 1000.0, 300.0 * rng.normal(size=(3, events)))
    error = np.where(wide, 10.0, 300.0)
    told = of_many(width, 1.0, across, along)._replace(
        sigma_spread_nm2=error, sigma_across_nm2=error, chi2_spread=np.where(wide, 1e4, 3.0)
    )
    table = rows(events).assign(status=np.where(wide, "poor_fit", "ok"))
    found = Extension.of(CONFIG, table, told, {})
    assert not found.is_common
    assert not found.is_long
    assert np.array_equal(found.flagged, wide)
    assert found.variance_nm2 < SIGMAS * found.variance_se_nm2
    assert found.variance_se_nm2 < 2 * 300.0 / 40**0.5  # proteins still say how wide they are


# ---- what a movie does not know of widths ------------------------------------------------------


@pytest.mark.parametrize("events", [4, 40])
def test_the_error_of_masses_has_the_width_that_a_movie_does_not_show(events: int) -> None:
    """Drawn from the prior: wiggles within frames or between them, and parts that are apart."""
    rng, sd = np.random.default_rng(12), CONFIG.uncertainty.wiggle_nm
    squares, seen_alone = [], []
    for trial in range(300):
        v, angle = (rng.normal() * sd) ** 2, rng.uniform(0, 2 * math.pi, events)
        apart, between = v * (trial % 3 == 0), v * rng.uniform() * (trial % 3 == 1)
        noise = 100.0 * rng.normal(size=(2, events))
        told = of_many(
            v + 1000.0 * rng.normal(size=events), 1000.0,
            apart * np.cos(angle) + noise[0], apart * np.sin(angle) + noise[1],
        )  # fmt: skip
        found = Extension.of(CONFIG, rows(events), told, in_time(between + 14.0 * rng.normal()))
        shift = found.mass_shift_kda[0] / 0.015
        squares.append((v / shift) ** 2)
        seen_alone.append((v / max(found.variance_nm2, 1.0)) ** 2)
    error = np.std(squares) / len(squares) ** 0.5
    assert abs(np.mean(squares) - 1) < SIGMAS * error + 0.1
    assert np.mean(seen_alone) > 10  # the control: what the width alone shows is no error


def test_many_particles_leave_a_small_error_and_an_input_turns_it_off() -> None:
    shares = []
    for events in (16, 1600):
        width = 1000.0 * np.random.default_rng(1).normal(size=events)
        told = of_many(width - width.mean(), 1000.0, np.zeros(events), np.zeros(events))
        shares.append(Extension.of(CONFIG, rows(events), told, {}).mass_shift_kda[0] / MASS_KDA)
    assert shares[0] < 0.015
    assert shares[1] < 0.0015
    certain = load_config(None, [*SETTINGS, "uncertainty.wiggle_nm=0"])
    assert not Extension.of(certain, rows(1600), told, {}).mass_shift_kda.any()


# ---- light that fluctuates -------------------------------------------------------------------


def breathing(
    relative: float, tau: float, masses: Sequence[float] = (MASS_KDA,) * 60, seed: int = 4
) -> tuple:
    """Frames of many events, and the errors of their means over the first 80, which are fitted."""
    rng, frames, one = np.random.default_rng(seed), 240, 3.0 * math.sqrt(40)
    repeats, errors = [], []
    for mass in masses:
        noise = rng.normal(size=(2, frames)) * one
        keep = math.exp(-1 / tau)
        drive = rng.normal(size=frames) * np.append(1.0, np.full(frames - 1, (1 - keep**2) ** 0.5))
        noise[1] += mass * relative * lfilter([1.0], [1.0, -keep], drive)
        fitted = noise[:, :80]
        errors.append(fitted[1].mean() - fitted[0].mean())
        series = (
            tuple(
                Series(np.tile(side, (3, 1)), np.ones(side.size), np.full(3, one**2), np.zeros(3))
                for side in sides
            )
            for sides in (fitted, noise)
        )
        repeats.append(repeats_of(*series))
    own = np.stack(repeats)[:, :BLOCK_ROWS, [2, -1]]
    tiles = np.full((5, 40), 400.0)
    achieved = {"mass_kda": pooled(own, tiles.copy(), tiles)}
    table, alone = rows(len(masses)).assign(mass_kda=masses), np.zeros(len(masses), dtype=bool)
    return Fluctuation.of("mass", table, repeats, achieved, alone), np.array(errors)


@pytest.mark.parametrize(("relative", "tau"), [(0.05, 20.0), (0.1, 5.0)])
def test_the_error_of_a_mass_has_what_breathing_leaves_in_the_mean(
    relative: float, tau: float
) -> None:
    found, errors = breathing(relative, tau)
    assert abs(found.relative - relative) < 4 * found.relative_se
    pull = errors / np.sqrt(9.0 + found.variance_kda2)
    assert abs(pull.std() - 1) < 0.3
    assert (errors / 3.0).std() > 1.4  # the control: without it, σ is too small


def test_few_heavy_particles_among_light_ones_show_it() -> None:
    masses = (205.0, 40.0, 40.0, 40.0) * 4
    seen = 0
    for seed in range(20):
        found, _ = breathing(0.05, 20.0, masses, seed)
        seen += found is not None and found.is_seen
    assert seen >= 15


def test_a_fluctuation_that_is_not_certain_is_in_the_error_all_the_same() -> None:
    """One heavy event among light ones: where it is not seen, the posterior still has a part."""
    masses, silent = (205.0,) + (40.0,) * 14, 0
    pulls, without = [], []
    for seed in range(40):
        found, errors = breathing(0.05, 20.0, masses, seed)
        silent += found is None or not found.is_seen
        added = 0.0 if found is None else found.variance_kda2
        pulls.append((errors / np.sqrt(9.0 + added))[0])
        without.append(errors[0] / 3.0)
    assert silent > 0
    assert np.std(without) > 2.0  # the control
    assert np.std(pulls) < 0.75 * np.std(without)


@pytest.mark.parametrize("tau", [100.0, 400.0])
def test_a_fluctuation_slower_than_windows_shows_in_the_frames_after_them(tau: float) -> None:
    pulls, without = [], []
    for seed in range(12):
        found, errors = breathing(0.05, tau, (MASS_KDA,) * 16, seed)
        assert found.is_seen
        assert "e+" not in found.finding.text
        pulls.extend(errors / np.sqrt(9.0 + found.variance_kda2))
        without.extend(errors / 3.0)
    assert np.std(without) > 2.5  # the control
    assert np.std(pulls) < 1.5
    assert np.max(np.abs(pulls)) < 5


def test_steady_light_does_not_fluctuate() -> None:
    growth = []
    for masses in ((205.0,) * 16, (205.0, 40.0, 40.0, 40.0) * 4):
        for seed in range(20):
            found, _ = breathing(0.0, 20.0, masses, seed)
            assert found is None or not found.is_seen
            added = 0.0 if found is None else found.variance_kda2.max()
            growth.append(math.sqrt(1 + added / 9.0))
    assert np.mean(growth) < 1.03  # σ of the heaviest; 1.006 with a standard error of 0.006


def test_one_event_that_changes_says_nothing_of_the_others() -> None:
    masses = (205.0,) + (1.0,) * 15
    for seed in range(20):
        found, _ = breathing(0.2, 20.0, masses, seed)
        assert found is None or not found.is_seen


# ---- steps that take their time --------------------------------------------------------------


def dated(
    course: np.ndarray, seed: int = 6, *, height: float = 0.05, expected: int = 0
) -> StepFrame:
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:13, :13]
    image = -height * np.exp(-((x - 6) ** 2 + (y - 6) ** 2) / 8)
    background = 1e4 * rng.uniform(0.8, 1.2, image.shape)
    counts = rng.poisson(background * (1 + course[:, None, None] * image)).astype("u2")
    every, used = np.ones(course.size), np.ones(image.shape, dtype=bool)
    patch = Patch(0, counts, every > 0, every, 1.0, 0.0, 0.0, background, used, ~used)
    return locate_step(patch, image, (50, 110), expected_rise=expected)


@pytest.mark.parametrize("rise", [12, 40])
def test_a_rise_is_found_and_its_frames_stay_out(rise: int) -> None:
    frames = np.arange(160)
    found = dated(np.clip((frames - 80) / rise + 0.5, 0, 1))
    assert abs(found.frame - 80) <= rise / 6
    assert abs(found.rise - rise) <= rise / 3
    assert found.kept_out(80) >= found.rise / 2
    assert found.height == pytest.approx(1.0, abs=0.06)
    assert found.p_constant > 1e-3


def test_faint_steps_tell_together_how_they_rise() -> None:
    """Each of them hides its rise in noise, and is dated with that of all."""
    course = np.clip((np.arange(160) - 80) / 18 + 0.5, 0, 1)
    faint = [dated(course, seed, height=0.009) for seed in range(30)]
    assert sum(one.rise > 0 for one in faint) < 10
    rise = common_rise([one.rise_profile for one in faint])
    assert 12 <= rise <= 27
    again = [dated(course, seed, height=0.009, expected=rise) for seed in range(30)]
    assert all(one.rise == rise for one in again)
    masses = np.array([one.height for one in again])
    assert abs(masses.mean() - 1) < 4 * masses.std() / 30**0.5
    step = (np.arange(160) >= 80).astype(float)
    sudden = [dated(step, seed, height=0.009) for seed in range(30)]
    assert common_rise([one.rise_profile for one in sudden]) == 0
    mixed = [one.rise_profile for one in [*sudden, *(dated(course, seed) for seed in range(3))]]
    assert common_rise(mixed) == 0  # a few that rise say nothing of the others
    assert dated(step, expected=18).rise == 0  # nor do others of one that is bright
    assert dated(step, 6).rise == 0


def test_a_step_does_not_rise_and_two_steps_are_no_line() -> None:
    frames = np.arange(160)
    step = (frames >= 80).astype(float)
    assert sum(dated(step, seed).rise > 0 for seed in range(40)) == 0
    assert dated(step + 0.5 * (frames >= 104)).p_constant < 1e-3


def test_light_that_settles_exponentially_goes_on_rising() -> None:
    frames = np.arange(160)
    settling = -np.expm1(-np.maximum(frames + 0.5 - 70, 0) / 15.0)
    found = [dated(settling, seed) for seed in range(20)]
    assert sum(one.rise > 0 for one in found) == 20
    assert sum(one.p_constant < 1e-3 for one in found) >= 15
    line = np.clip((frames - 80) / 40 + 0.5, 0, 1)
    straight = [dated(line, seed) for seed in range(20)]
    assert sum(one.p_constant < 1e-3 for one in straight) <= 1  # the control
    for course, goes_on in ((settling, True), (line, False)):  # of which no single one shows it
        faint = [dated(course, seed, height=0.015, expected=40) for seed in range(20)]
        assert sum(one.p_constant < 1e-3 for one in faint) <= 2
        assert go_on_rising([one.settling for one in faint]) == goes_on


# ---- places that are shared ------------------------------------------------------------------


def test_steps_of_a_particle_that_is_there_are_told_from_others() -> None:
    table = pd.DataFrame({
        "x_nm": [0.0, 40.0, 900.0, 1800.0, 1820.0, 3000.0, 3010.0],
        "y_nm": 0.0,
        "frame": [100, 300, 310, 400, 430, 500, 700],
        "mass_kda": [205.0, -12.0, 12.0, 100.0, 90.0, 60.0, -61.0],
        "sigma_mass_kda": 3.0, "n_before": 80, "n_after": 80, "status": "ok",
    })  # fmt: skip
    assert at_a_shared_place(table).tolist() == [False, True] + [False] * 5
    parts = [False] * 3 + [True] * 2 + [False] * 2
    assert in_parts(table, np.zeros(7)).tolist() == parts
    table.loc[4, "frame"] = 490
    assert not in_parts(table, np.zeros(7)).any()
    assert in_parts(table, np.full(7, 20.0)).tolist() == parts  # frames that their windows lack
    table.loc[1, "x_nm"] = 190.0  # beside it, as of a particle that moved
    assert at_a_shared_place(table, 370.0)[1]
    assert not at_a_shared_place(table, 300.0)[1]
    table.loc[1, "mass_kda"] = -50.0  # which no small move makes
    assert not at_a_shared_place(table, 370.0)[1]
    table.loc[1, ["x_nm", "mass_kda"]] = 40.0, -90.0  # by more than a third
    assert not at_a_shared_place(table)[1]
    assert at_a_shared_place(table, relative=0.1)[1]  # unless contrasts fluctuate by 10 %
    table.loc[1, ["x_nm", "mass_kda"]] = 40.0, -12.0
    table.loc[1, "frame"] = 10  # before the particle came: another one
    assert not at_a_shared_place(table)[1]


def test_faint_steps_may_rise_as_the_bright_ones_do() -> None:
    table = rows(30)
    table.loc[20:, "mass_kda"] = 40.0
    rise = np.where(np.arange(30) < 15, 40.0, 0.0)
    told = Evidence(*np.zeros((10, 30)), rise)
    table["flags"] = ""
    alone = np.zeros(30, dtype=bool)
    unseen, frames = may_rise(table, told, alone)
    assert frames == 40
    assert unseen.tolist() == [False] * 20 + [True] * 10
    table.loc[20:, "mass_kda"] = 60.0  # of which some show it, and some do not
    assert may_rise(table, told, alone)[0].tolist() == [False] * 20 + [True] * 10
    few = Evidence(*np.zeros((10, 30)), np.where(np.arange(30) < 2, 40.0, 0.0))
    assert not may_rise(table, few, alone)[0].any()
    assert not may_rise(table, told, np.arange(30) < 15)[0].any()  # changes of particles
