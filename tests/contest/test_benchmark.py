"""The statistics of a study on numbers whose answer is known, and its files."""

from __future__ import annotations

import json
import math
from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
from microscopes import configuration, setting

from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.inference.posterior import van_trees
from iscat_analysis.records import FREE_PARAMETERS
from iscat_analysis.report import BENCHMARK_NAMES, render_benchmark
from iscat_analysis.report.benchmark import mode_charts, ranking_section
from iscat_analysis.report.vega import figures_in
from iscat_analysis.study import (
    make_setting,
    pull_histogram,
    rank_test,
    run_trials,
    score,
    share_interval,
    spread_error,
    spread_interval,
)
from iscat_contest.benchmark import run_benchmark, write_benchmark
from iscat_contest.process import answer, job_of
from iscat_contest.simple import gauss_ls, peak

SMALL = {"fit": {"roi_nm": 900.0, "z_range_nm": [0.0, 300.0]}}


@pytest.fixture(scope="module")
def study() -> dict[str, object]:
    return run_benchmark(configuration(**SMALL), trials=20, seed=3, workers=2, posterior=False)


# ---- statistics ------------------------------------------------------------------------------


def test_score_of_a_normal_sample() -> None:
    error = np.random.default_rng(1).normal(0.5, 2.0, 20_000)
    found = score(error, np.full(error.size, 2.0), 2.0, 1.0)
    assert abs(found.bias - 0.5) < 4 * found.bias_se
    assert found.bias_se == pytest.approx(found.spread / math.sqrt(error.size))
    assert found.spread_ci95[0] < 2.0 < found.spread_ci95[1]
    assert found.spread_over_crb == pytest.approx(found.spread / 2)
    assert found.spread_over_qcrb == pytest.approx(found.spread)
    assert found.spread_robust == pytest.approx(found.spread, rel=0.03)
    assert found.pull_mean == pytest.approx(found.bias / 2)
    assert found.coverage95 == pytest.approx(0.943, abs=0.01)


def test_score_leaves_out_nan_and_refuses_few() -> None:
    error = np.array([1.0, -1.0] * 10 + [np.nan])
    assert score(error, np.ones(21), 1.0, 1.0).bias == 0.0
    assert math.isnan(score(error[:4], np.ones(4), 1.0, 1.0).spread)
    assert math.isnan(score(error, np.full(21, np.nan), 1.0, 1.0).coverage68)
    assert math.isnan(score(error, np.ones(21), math.nan, 1.0).spread_over_crb)


def test_interval_knows_the_kurtosis() -> None:
    rng = np.random.default_rng(2)
    normal, heavy = rng.normal(size=50_000), rng.laplace(size=50_000)
    assert spread_error(normal) == pytest.approx(1 / math.sqrt(2 * normal.size), rel=0.05)
    assert spread_error(heavy) == pytest.approx(math.sqrt(5 / 4 / heavy.size), rel=0.1)
    covered = 0
    for _ in range(400):
        low, high = spread_interval(rng.normal(size=200))
        covered += low < 1 < high
    assert covered > 362  # 380 expected, 4 standard errors fewer at most
    assert spread_interval(np.ones(10)) == (0.0, 0.0)


def test_interval_of_a_share_covers_it() -> None:
    rng = np.random.default_rng(4)
    for truth in (0.6827, 0.95):
        covered = 0
        for _ in range(400):
            low, high = share_interval(rng.random(50) < truth)
            covered += low < truth < high
        assert 360 < covered < 400  # 380 expected
    found = score(rng.normal(size=1000), np.ones(1000), 1.0, 1.0)
    assert found.coverage68_ci95[0] < found.coverage68 < found.coverage68_ci95[1]
    assert found.coverage95_ci95[0] < 0.95 < found.coverage95_ci95[1]
    assert share_interval(np.ones(20, dtype=bool)) == pytest.approx((0.839, 1.0), abs=1e-3)
    assert all(math.isnan(end) for end in share_interval(np.zeros(0, dtype=bool)))


def test_rank_test_accepts_uniform_and_rejects_others() -> None:
    rng = np.random.default_rng(3)
    p_value, counts = rank_test(rng.integers(0, 100, 1000), 100)
    assert p_value > 1e-3
    assert counts.sum() == 1000
    centred = (100 * rng.beta(2, 2, 1000)).astype(int)
    assert rank_test(centred, 100)[0] < 1e-6
    with pytest.raises(ConfigError, match="evenly"):
        rank_test(centred, 100, bins=7)


def test_pull_histogram_keeps_every_pull() -> None:
    bins = pull_histogram(np.array([-9.0, 0.1, 0.2, 7.0, np.nan]))
    assert sum(bins["counts"]) == 4
    assert sum(bins["expected"]) == pytest.approx(4)
    assert bins["counts"][0] == bins["counts"][-1] == 1


def test_van_trees_adds_information() -> None:
    data = np.array([[4.0, 1.0], [1.0, 2.0]])
    nothing = np.zeros((2, 2))
    alone = np.sqrt(np.diag(np.linalg.inv(data)))
    assert van_trees(data, nothing) == pytest.approx(alone)
    assert np.all(van_trees(data, np.eye(2)) < alone)
    assert van_trees(nothing, 4 * np.eye(2)) == pytest.approx([0.5, 0.5])
    with pytest.raises(ConfigError, match="determine"):
        van_trees(np.diag([1.0, 0.0]), nothing)


# ---- settings ----------------------------------------------------------------------------------


def test_a_setting_has_the_photons_that_were_asked_for() -> None:
    for scheme in ("iscat", "cobri", "darkfield"):
        made = setting(scheme, "joint", photons=1234.0)
        assert made.experiment.collected == pytest.approx(1234.0)
        assert made.described()["scheme"] == scheme


def test_the_height_is_moved_off_the_ends_only_where_it_is_free_and_not_given() -> None:
    assert setting("iscat", "mass").truth[2] == 5.0
    assert setting("iscat", "joint", photons=100.0).truth[2] > 5.0
    assert setting("iscat", "joint", z_nm=5.0).truth[2] == 5.0
    assert setting("iscat", "joint", bounds={"z_nm": 7.0}).truth[2] == 7.0


@pytest.mark.parametrize("scheme", ["iscat", "darkfield"])
@pytest.mark.parametrize("n_before", [0, 20])
@pytest.mark.parametrize("method", ["fixed", "known"])
def test_fits_know_as_much_of_the_background_as_the_bounds(
    scheme: str, n_before: int, method: str
) -> None:
    """Whether it was measured is for [bounds] to say; the observed information then agrees."""
    config = configuration(
        scheme, bounds={"n_before": n_before}, background={"method": method, "level_e": 2.0}
    )
    first = make_setting(config, "mass", collected=3000.0)
    later = make_setting(config, "mass", collected=1000.0, context=first.context)
    for made in (first, later):
        likelihood = made.likelihood(made.draw(made.truth, None))
        theta = np.array([*made.truth[:3], likelihood.model.scale.amplitude(made.truth[3]), 0.0])
        fisher = likelihood.score_fisher(theta)[2][:2, :2]
        crb = made.bounds.crb_single[:2]
        assert 1 / np.sqrt(np.diag(fisher)) == pytest.approx(crb, rel=1e-3)


def test_a_particle_that_no_fit_can_find_is_refused() -> None:
    """Beyond the range profiles are continued wrongly, and every mode would be biased."""
    for mode in ("mass", "joint"):
        with pytest.raises(ConfigError, match=r"fit\.z_range_nm = \[0, 1000\]"):
            setting("iscat", mode, bounds={"z_nm": 2000.0})
    high = {"particle": {"height_nm": 2000.0}, "bounds": {"z_nm": 1900.0}, "calibration": None}
    assert setting("iscat", "mass", **high).truth[2] == 1900.0
    with pytest.raises(ConfigError, match="widen"):
        setting("iscat", "joint", **high)
    with pytest.raises(ConfigError, match=r"enlarge fit\.roi_nm"):
        setting("iscat", "mass", bounds={"x_nm": 1400.0})


def test_expected_counts_give_back_the_truth() -> None:
    made = make_setting(configuration(**SMALL), "joint")
    likelihood = made.likelihood(made.draw(made.truth, None))
    theta = np.array([*made.truth[:3], likelihood.model.scale.amplitude(made.truth[3]), 0.0])
    score_vector = likelihood.score_fisher(theta)[1]
    sigma = 1 / np.sqrt(np.diag(likelihood.score_fisher(theta)[2]))
    assert np.abs(score_vector * sigma)[:4].max() < 1e-6


SPHERE: dict[str, dict[str, object]] = {
    "particle": {"kind": "silica", "model": "mie", "mass_kda": None, "diameter_nm": 120.0},
    "calibration": None,  # type: ignore[dict-item]
    "fit": {"mode": "size", "roi_nm": 900.0, "z_range_nm": [0.0, 300.0]},
    "bounds": {"photons_per_pixel": 2e3},
}


def test_spheres_are_scored_in_their_diameter(repetitions: Callable[[int, int], int]) -> None:
    """Pulls and efficiency; the diameter's bound is that of the mass over dm/dd."""
    with pytest.raises(ConfigError, match="of dipoles"):
        make_setting(configuration(**SPHERE), "mass")
    made = make_setting(configuration(**SPHERE), "size")
    assert list(made.scored) == ["x_nm", "y_nm", "z_nm", "diameter_nm"]
    mass, bound = made.truth[3], made.bounds.crb_joint[3]
    assert made.crb[3] == pytest.approx(bound * 120.0 / (3 * mass))
    trials = repetitions(30, 300)
    found = run_trials(made, trials, seed=1)
    error = (found.estimate - found.truth)[found.usable, 3]
    assert found.truth[0, 3] == pytest.approx(120.0)
    assert len(error) == trials
    doubt = 4 / math.sqrt(trials)
    assert abs(np.mean(error)) < doubt * made.crb[3]
    for width in (made.crb[3], found.sigma[:, 3]):
        assert abs(np.std(error / width) - 1) < doubt / math.sqrt(2)


def test_baselines_are_exact_without_noise() -> None:
    made = setting("iscat", "mass")
    noiseless = made.draw(made.truth, None)
    job = job_of(made, noiseless.before_e[None], noiseless.after_e[None], made.truth[None].copy())
    gauss, highest = answer(gauss_ls, job).columns, answer(peak, job).columns
    assert gauss["mass_kda"][0] == pytest.approx(made.truth[3], rel=1e-6)
    assert highest["mass_kda"][0] == pytest.approx(made.truth[3], rel=1e-9)
    assert math.hypot(gauss["x_nm"][0] - made.truth[0], gauss["y_nm"][0] - made.truth[1]) < 5.0


# ---- the study and its files ---------------------------------------------------------------------


@pytest.mark.large
def test_study_repeats_itself_with_any_number_of_workers(study: dict[str, object]) -> None:
    again = run_benchmark(configuration(**SMALL), trials=20, seed=3, workers=1, posterior=False)
    for mode in ("mass", "localize", "joint"):
        for name in FREE_PARAMETERS[mode]:
            assert _text(study[mode][name]) == _text(again[mode][name])
    assert _text(study["curves"]) == _text(again["curves"])
    other = run_benchmark(configuration(**SMALL), trials=20, seed=4, workers=2, posterior=False)
    assert _text(other["curves"]) != _text(study["curves"])


def _text(value: object) -> str:
    return json.dumps(value, sort_keys=True, default=float)


def test_study_is_written_whole(study: dict[str, object], tmp_path) -> None:
    folder = tmp_path / "out"
    write_benchmark(study, folder)
    (folder / "benchmark.json").write_text("{}")
    with pytest.raises(DataError, match="overwrite"):
        write_benchmark(study, folder)
    assert write_benchmark(study, folder, overwrite=True) == folder
    assert {entry.name for entry in folder.iterdir()} == {*BENCHMARK_NAMES, ".iscat-files"}
    plain = json.loads((folder / "benchmark.json").read_text(encoding="utf-8"))
    assert plain["mass"]["x_nm"]["crb"] == pytest.approx(study["mass"]["x_nm"]["crb"])
    drawn = set(figures_in(folder / "benchmark.html"))
    assert {"photons-joint", "heights-mass", "pulls-joint"} <= drawn
    page = (folder / "benchmark.html").read_text(encoding="utf-8")
    assert "spread / CRB" in page
    low, high = (f"{100 * end:.1f}" for end in plain["joint"]["z_nm"]["coverage68_ci95"])
    assert f"[{low}, {high}]" in page


def test_page_shows_how_sure_each_spread_is(study: dict[str, dict[str, object]]) -> None:
    """The bars of the figure end where the intervals do."""
    ends = np.array(study["curves"]["z"]["joint"]["z_nm"]["spread_ci95"])  # type: ignore[index]
    (chart,) = (one for one in mode_charts(study, "joint") if one.id == "heights-joint")
    rows = pd.DataFrame(chart.figure.data["rows"])
    drawn = rows[(rows["panel"] == "z [nm]") & (rows["kind"] == "point")]
    np.testing.assert_allclose(drawn[["low", "high"]], ends, rtol=1e-5)
    assert 'id="heights-joint-figure"' in render_benchmark(study)


def test_page_of_a_study_without_usable_fits(study: dict[str, dict[str, object]]) -> None:
    kept = study["joint"]["z_nm"]
    nothing = vars(score(np.zeros(0), np.zeros(0), kept["crb"], kept["qcrb"]))
    none = {key: (math.nan,) * 2 for key in kept if key.startswith("posterior")}
    lost = {**study["joint"], "z_nm": {**kept, **none, **nothing, "posterior_coverage68": math.nan,
                                       "posterior_coverage95": math.nan}}  # fmt: skip
    page = render_benchmark({**study, "joint": lost})
    assert "— ±" not in page
    assert "[—" not in page


def test_who_does_not_follow_the_particle_stands_below_all_that_are_ranked() -> None:
    verdict = "does not follow the particle: its mean hardly moves with the truth"
    parts = {"joint": {"estimators": {"constant": {"x_nm": {"verdict": verdict}}, "late": {}}}}
    ranking = [
        {"estimator": "constant", "kept": 0.01, "below_bound": False},
        {"estimator": "late", "kept": 0.0, "below_bound": False},
    ]
    (table,) = ranking_section({"ranking": ranking}, parts).tables
    assert [row[:2] for row in table.rows] == [[1, "late"], ["—", "constant"]]
    assert verdict in table.rows[1][-1]


def test_too_few_trials_are_refused() -> None:
    with pytest.raises(ConfigError, match="at least 20"):
        run_benchmark(configuration(**SMALL), trials=5)
