"""The scale that estimators are put on, judged by estimators whose place on it is known."""

from __future__ import annotations

import json
import os
import signal
import time
import tracemalloc
from importlib.metadata import EntryPoint
from pathlib import Path

import estimators_for_tests
import numpy as np
import pandas as pd
import pytest
from microscopes import configuration

import iscat_analysis as ia
from iscat_analysis.config import Config
from iscat_analysis.records import FREE_PARAMETERS, PARAMETERS
from iscat_analysis.study import (
    limits_of_many,
    make_setting,
    paired,
    power_bound,
    recall_at,
    resamples,
    score_estimates,
)
from iscat_contest.benchmark import draw
from iscat_contest.estimators import (
    BUILT_IN,
    GROUP,
    Estimate,
    checked_table,
    find_estimator,
    known_estimators,
)
from iscat_contest.process import Answer, answer, read_answers, run_estimator

COUNT = 400
COUNTED = 12
FREE = FREE_PARAMETERS["joint"]
SMALL = {"fit": {"roi_nm": 900.0, "z_range_nm": [0.0, 300.0], "mode": "joint"}}


@pytest.fixture(scope="module")
def config() -> Config:
    return configuration(fit={"mode": "joint"}, bounds={"pixels": 31})


@pytest.fixture(scope="module")
def ideal(config: Config) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Give truths, and estimates that are normal with the covariance of the bound."""
    random = np.random.default_rng(5)
    middle = np.array([0.0, 0.0, 100.0, 1000.0])
    covariance = limits_of_many(config, FREE, middle[None]).covariance[0]
    width = 5 * np.sqrt(np.diag(covariance))
    truth = middle + width * random.uniform(-1, 1, (COUNT, 4))
    estimate = truth + random.multivariate_normal(np.zeros(4), covariance, COUNT)
    sigma = {f"sigma_{name}": w / 5 for name, w in zip(FREE, width, strict=True)}
    columns = list(PARAMETERS)
    return pd.DataFrame(truth, columns=columns), pd.DataFrame(estimate, columns=columns).assign(
        **sigma
    )


# ---- the bound -----------------------------------------------------------------------------------


def test_an_estimator_at_the_bound_has_efficiency_one(config, ideal) -> None:
    truth, estimate = ideal
    found = ia.efficiency(estimate, truth, config)
    assert tuple(found.index) == FREE
    se = np.sqrt(2 / COUNT)
    np.testing.assert_allclose(found["efficiency_crb"], 1.0, atol=4 * se)
    np.testing.assert_allclose(found["spread_over_crb"], 1.0, atol=4 * se / 2)
    np.testing.assert_allclose(found["pull_std"], 1.0, atol=4 * se / 2)
    np.testing.assert_allclose(found["coverage68"], 0.683, atol=4 * np.sqrt(0.22 / COUNT))
    assert not found["below_bound"].any()
    assert set(found["verdict"]) == {""}


def test_the_truth_is_below_the_bound(config, ideal) -> None:
    truth, estimate = ideal
    assert ia.efficiency(truth, truth, config)["below_bound"].all()
    nearer = truth + 0.8 * (estimate[list(PARAMETERS)] - truth)
    assert ia.efficiency(nearer, truth, config)["below_bound"].all()


def test_a_bias_that_shrinks_the_spread_is_no_gain(config, ideal) -> None:
    """Shrunk towards their mean, estimates lie below the CRB and at the bound of biased ones."""
    truth, estimate = ideal
    middle = truth.mean()
    shrunk = middle + 0.6 * (estimate[list(PARAMETERS)] - middle)
    found = ia.efficiency(shrunk, truth, config)
    assert not found["below_bound"].any()
    np.testing.assert_allclose(found["spread_over_crb"], 0.6, atol=0.1)
    np.testing.assert_allclose(found["bias_gradient"], -0.4, atol=0.05)
    np.testing.assert_allclose(found["spread_over_biased_bound"], 1.0, atol=0.15)
    assert found["verdict"].str.contains("by its bias").all()
    still = pd.DataFrame({name: np.full(COUNT, middle[name]) for name in PARAMETERS})
    assert ia.efficiency(still, truth, config)["verdict"].str.contains("does not follow").all()


def test_intervals_hold_the_efficiency_in_as_many_studies_as_they_say(config) -> None:
    """200 studies of 100 trials; the nominal 95 % with 4 standard errors and some for the small."""
    random = np.random.default_rng(6)
    limits = limits_of_many(config, FREE, np.array([[0.0, 0.0, 100.0, 1000.0]]))
    covered = 0
    limits = limits.for_rows([0] * 100)
    for _ in range(200):
        noise = random.normal(size=100) * limits.crb[0, 0]
        found = score_estimates({"x_nm": noise}, limits, 1)
        low, high = found["x_nm"]["efficiency_crb_ci95"]
        covered += low < 1 < high
    assert covered > 200 * 0.95 - 4 * np.sqrt(200 * 0.95 * 0.05) - 4


def test_bounds_are_those_of_the_program(config) -> None:
    table, report = ia.bounds_for(config), ia.compute_bounds(config)
    for name in FREE:
        assert table.loc[name, "crb"] == pytest.approx(report.report["actual"]["crb_joint"][name])
        assert table.loc[name, "qcrb"] == pytest.approx(report.report["actual"]["qcrb"][name])
        assert table.loc[name, "holevo"] == pytest.approx(report.report["holevo"][name])
    assert tuple(ia.bounds_for(config, mode="mass").index) == FREE_PARAMETERS["mass"]


def test_a_few_particles_are_no_proof(config, ideal) -> None:
    truth, estimate = ideal
    few = ia.efficiency(truth[:10], truth[:10], config)
    assert not few["below_bound"].any()
    assert ia.efficiency(estimate[:5], truth[:5], config)["verdict"].str.contains("too few").all()


def test_tables_are_matched_by_event_or_refused(config, ideal) -> None:
    truth, estimate = ideal
    numbered = truth.assign(event=range(COUNT))
    mixed = estimate.assign(event=range(COUNT)).sample(frac=0.75, random_state=1)
    found = ia.efficiency(mixed, numbered, config)
    assert set(found["answered"]) == {len(mixed)}
    assert set(found["failed"]) == {COUNT - len(mixed)}
    with pytest.raises(ia.DataError, match="the same rows"):
        ia.efficiency(estimate[:10], truth, config)
    with pytest.raises(ia.DataError, match="twice"):
        ia.efficiency(pd.concat([mixed, mixed]), numbered, config)
    with pytest.raises(ia.DataError, match="none of the columns"):
        ia.efficiency(pd.DataFrame({"event": range(COUNT)}), numbered, config)
    with pytest.raises(ia.ConfigError, match="choose one of mass, localize, joint"):
        ia.efficiency(estimate, truth, config, mode="track")


def test_differences_are_paired() -> None:
    random = np.random.default_rng(7)
    common, small = random.normal(size=400), 0.1 * random.normal(size=400)
    found = paired(1.1 * common, common + small, np.ones(400), resamples(400, 1))
    low, high = found["mse_ratio_ci95"]
    assert low < 1.21 / 1.01 < high
    assert high - low < 0.15  # unpaired, it would be about 0.4


def test_recall_of_the_matched_filter_is_its_bound() -> None:
    random = np.random.default_rng(8)
    empty, signal = random.normal(size=4000), 2.5 + random.normal(size=4000)
    found = recall_at(np.maximum(empty, 0), np.maximum(signal, 0), 0.05, 1)
    assert found["recall"] == pytest.approx(power_bound(2.5, 0.05), abs=0.03)
    assert power_bound(0.0, 0.05) == pytest.approx(0.05)


# ---- estimators ----------------------------------------------------------------------------------


def test_what_an_estimator_returns_is_checked() -> None:
    rows = checked_table({"x_nm": [1.0, np.inf], "index": [2, 0], "other": ["a", "b"]}, 3)
    np.testing.assert_array_equal(rows["x_nm"], [np.nan, np.nan, 1.0])
    for table, said in (
        ([1.0], "no table"),
        ({"other": [1.0]}, "none of the columns"),
        ({"x_nm": [1.0]}, "one for each"),
        ({"x_nm": [1.0, 2.0], "index": [1, 1]}, "two rows"),
        ({"x_nm": [1.0], "index": [3]}, "not one of"),
    ):
        with pytest.raises(ia.ConfigError, match=said):
            checked_table(table, 3)


def test_estimators_are_found_by_name_or_function(monkeypatch: pytest.MonkeyPatch) -> None:
    assert {one.name for one in known_estimators()} >= {one.name for one in BUILT_IN}
    assert find_estimator("json:dumps").target == "json:dumps"
    with pytest.raises(ia.ConfigError, match="neither PACKAGE:FUNCTION nor one of iscat"):
        find_estimator("gauss")
    monkeypatch.setattr("iscat_contest.estimators.find_spec", lambda _: None)
    with pytest.raises(ia.ConfigError, match="--no-deps piscat"):
        find_estimator("piscat").load()
    found = {GROUP: [EntryPoint("theirs", "json:dumps", GROUP)]}  # of another package
    monkeypatch.setattr("iscat_contest.estimators.entry_points", lambda *, group: found[group])
    assert known_estimators()[-1].name == "theirs"
    assert find_estimator("theirs").load() is json.dumps


@pytest.fixture(scope="module")
def drawn():
    return draw(make_setting(configuration(**SMALL), "mass"), COUNTED, seed=1, stream=1)


@pytest.fixture(scope="module")
def in_focus():
    config = configuration(
        optics={"focus_nm": -300.0}, bounds={"photons_per_pixel": 1e5}, fit={"roi_nm": 1900.0}
    )
    return draw(make_setting(config, "mass"), COUNTED, seed=2, stream=1)


@pytest.mark.parametrize(
    ("estimate", "said"),
    [
        (estimators_for_tests.raises, "ZeroDivisionError: by design, of 3"),
        (estimators_for_tests.gives_nan, "no number"),
        (estimators_for_tests.gives_a_list, "returned list"),
    ],
)
def test_a_failure_is_counted_with_its_reason(estimate: Estimate, said: str, drawn) -> None:
    found = answer(estimate, drawn.job)
    assert sum(found.failures.values()) == COUNTED
    assert said in next(iter(found.failures))
    assert not any(np.isfinite(column).any() for column in found.columns.values())


@pytest.mark.parametrize(
    ("name", "limit_s", "said"),
    [("hangs", 0.5, "no answer within 0.5 s"), ("ends_its_process", 300.0, "ended with status 7")],
)
def test_a_process_that_hangs_or_dies_is_counted(name, limit_s, said, drawn, repo_root) -> None:
    one = find_estimator(f"estimators_for_tests:{name}")
    found = run_estimator(one, [drawn.job, drawn.job], limit_s, [str(repo_root / "tests")])
    assert [sum(part.failures.values()) for part in found] == [COUNTED, COUNTED]
    assert said in next(iter(found[0].failures))


def _alive(number: int) -> bool:
    """Tell whether a process is at work; one that ended and was not collected is not."""
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc")
@pytest.mark.parametrize("hang", ["", "yes"])
def test_what_an_estimator_starts_ends_with_it(
    hang, drawn, repo_root, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Twenty forked processes that ignore SIGTERM, of an estimator that answers or hangs."""
    monkeypatch.setenv("CHILDREN", str(tmp_path / "children"))
    monkeypatch.setenv("HANG", hang)
    one = find_estimator("estimators_for_tests:leaves_children")
    limit_s = 15.0 if hang else 300.0
    found = run_estimator(one, [drawn.job], limit_s, [str(repo_root / "tests")])
    children = json.loads((tmp_path / "children").read_text(encoding="utf-8"))
    assert len(children) == 20
    deadline = time.monotonic() + 20  # the system may be slow to end what was killed
    while any(map(_alive, children)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(map(_alive, children))
    assert sum(found[0].failures.values()) == (COUNTED if hang else 0)


def test_a_process_that_leaves_its_group_keeps_nobody_waiting(
    drawn, repo_root, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It holds the pipe, and is the limit of what SECURITY.md promises."""
    monkeypatch.setenv("CHILDREN", str(tmp_path / "children"))
    one = find_estimator("estimators_for_tests:leaves_its_group")
    begin = time.monotonic()
    (found,) = run_estimator(one, [drawn.job], 300.0, [str(repo_root / "tests")])
    assert time.monotonic() - begin < 50
    assert "ended with status 7" in next(iter(found.failures))
    for child in json.loads((tmp_path / "children").read_text(encoding="utf-8")):
        os.kill(child, signal.SIGKILL)


def test_what_an_estimator_shouts_is_not_kept(drawn, repo_root) -> None:
    """Of 300 MB the last line is told, and the rest is in no memory and no file."""
    one = find_estimator("estimators_for_tests:shouts")
    tracemalloc.start()
    (found,) = run_estimator(one, [drawn.job], 300.0, [str(repo_root / "tests")])
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "ended with status 3: the last line" in next(iter(found.failures))
    assert most < 10_000_000


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("pipe", "it is a pipe or a device"),
        ("folder", "Is a directory"),
        ("nothing", "No such file"),
        ("/etc/passwd", "their file is a link"),
        ("/dev/zero", "their file is a link"),
    ],
)
def test_answers_are_read_from_a_plain_file(
    what, said, drawn, repo_root, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ANSWERS", what)
    one = find_estimator("estimators_for_tests:replaces_its_answers")
    found = run_estimator(one, [drawn.job] * 2, 300.0, [str(repo_root / "tests")])
    assert [sum(part.failures.values()) for part in found] == [COUNTED, COUNTED]
    assert said in next(iter(found[0].failures))


_GOOD = Answer({"x_nm": np.array([1.0, np.nan, 3.0, 4.0])}, {"no number": 1}, 0.5).line()


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (_GOOD.replace("[1.0,null,3.0,4.0]", "[1.0]"), "of 4 regions"),
        (_GOOD.replace("[1.0,null,3.0,4.0]", "1.0"), "columns.x_nm: Input should be a valid array"),
        (_GOOD.replace("[1.0,null,3.0,4.0]", "[[1.0],2.0,3.0,4.0]"), "columns.x_nm.0: "),
        (_GOOD.replace("3.0", "NaN"), "columns.x_nm.2: Input should be a finite number"),
        (_GOOD.replace("3.0", "Infinity"), "columns.x_nm.2: Input should be a finite number"),
        (_GOOD.replace("3.0", "1e999"), "columns.x_nm.2: Input should be a finite number"),
        (_GOOD.replace("3.0", "9" * 5000), ""),
        (_GOOD.replace("3.0", '"3.0"'), "columns.x_nm.2: Input should be a valid number"),
        (_GOOD.replace("3.0", "true"), "columns.x_nm.2: Input should be a valid number"),
        (_GOOD.replace("x_nm", "sigma_sigma_x_nm"), "its columns are not"),
        (_GOOD.replace("x_nm", "__class__"), "its columns are not"),
        (_GOOD.replace("null", "2.0"), "does not account for 4 regions"),
        (_GOOD.replace(":1}", ":-1}"), "failures.no number: Input should be greater"),
        (_GOOD.replace(":1}", ":1.5}"), "failures.no number: Input should be a valid integer"),
        (_GOOD.replace("no number", "n" * 1000), "at most 300 characters"),
        (_GOOD.replace("seconds", "second", 1), "seconds: Field required"),
        (_GOOD.replace("0.5", '"soon"'), "seconds: Input should be a valid number"),
        (_GOOD.replace('{"columns"', '{"more":1,"columns"'), "more: Extra inputs"),
        (_GOOD[:-1], "Invalid JSON"),
        ("[" * 10_000, "Invalid JSON"),
        ("\0", "Invalid JSON"),
        ("null", "Input should be an object"),
        ("x" * 100_000, "bytes long"),
    ],
)
def test_answers_of_another_form_are_refused(line: str, said: str, tmp_path: Path) -> None:
    """What was answered before them counts, as it does where a process ends too early."""
    path = tmp_path / "answers"
    path.write_text(f"{_GOOD}\n{line}\n{_GOOD}\n", encoding="utf-8")
    done, refused = read_answers(path, [4, 4, 4])
    assert said in refused
    assert len(done) == (0 if "bytes long" in said else 1)
    path.write_bytes(b"\xff\xfe\n")
    assert "Invalid JSON" in read_answers(path, [4])[1]


def test_answers_are_as_many_as_were_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "answers"
    path.write_text(f"{_GOOD}\n" * 3 + _GOOD, encoding="utf-8")
    done, refused = read_answers(path, [4, 4, 4])
    assert not refused
    np.testing.assert_array_equal(done[2].columns["x_nm"], [1.0, np.nan, 3.0, 4.0])
    assert (done[2].failures, done[2].seconds) == ({"no number": 1}, 0.5)
    assert np.isnan(done[2].peak_mb)
    assert read_answers(path, [4, 4]) == (
        [],
        "its answers are refused: there are 3, and 2 were asked for",
    )


def test_one_bad_region_costs_no_other_and_any_amplitude_becomes_a_mass(drawn) -> None:
    some = answer(estimators_for_tests.raises_for_some, drawn.job)
    answered = int(np.isfinite(some.columns["x_nm"]).sum())
    assert 0 < answered < COUNTED
    assert some.failures == {"ValueError: a bad one": COUNTED - answered}
    assert some.peak_mb > 1
    assert some.seconds >= 0
    found = answer(estimators_for_tests.amplitude_of_the_middle, drawn.job)
    assert np.median(found.columns["mass_kda"]) == pytest.approx(1000, rel=0.1)
    assert np.all(found.columns["sigma_mass_kda"] > 0)
    assert not found.failures


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of what trackpy asks of pandas
@pytest.mark.parametrize("name", [one.name for one in BUILT_IN if not one.install])
def test_every_built_in_estimator_finds_a_bright_particle(name: str, in_focus) -> None:
    """Within a sixth of a wavelength, where the spot is about as round as a Gaussian."""
    found = answer(find_estimator(name).load(), in_focus.job)
    assert not found.failures
    for axis, column in enumerate(("x_nm", "y_nm")):
        error = np.abs(found.columns[column] - in_focus.limits.truths[:, axis])
        assert np.median(error) < 80
    if "mass_kda" in found.columns:
        ratio = found.columns["mass_kda"] / in_focus.limits.truths[:, 3]
        assert np.median(ratio) == pytest.approx(1, abs=0.25)


def test_all_estimators_see_the_same_counts() -> None:
    setting = make_setting(configuration(**SMALL), "mass")
    first, again = (draw(setting, 5, seed=3, stream=1) for _ in range(2))
    np.testing.assert_array_equal(first.job.after, again.job.after)
    assert np.all(np.ptp(first.limits.truths[:, [0, 1, 3]], axis=0) > 0)
    assert np.ptp(first.limits.truths[:, 2]) == 0
    assert not np.array_equal(first.job.after, draw(setting, 5, seed=4, stream=1).job.after)
