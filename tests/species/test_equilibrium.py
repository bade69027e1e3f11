"""Equilibria: mass action, the likelihood's slope, K_D from a few tables, and what is refused."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from event_tables import draw_series
from scipy.optimize import brentq
from scipy.stats import exponnorm, norm

import iscat_analysis as ia
from iscat_analysis._kernels.mixture import mixture_score
from iscat_analysis.day.table import read_table
from iscat_analysis.report.vega import figures_in
from iscat_analysis.species import Efficiency
from iscat_analysis.species.equilibrium import (
    COMPOSITION,
    LANDING_POWER,
    Model,
    _Equilibrium,
    at_equilibrium,
    landing_logits,
)
from iscat_analysis.species.events import Events
from iscat_analysis.species.maximum import Problem, maximise
from iscat_analysis.species.series import MEANS, SHARES, VARIANCES, Series
from iscat_analysis.species.tables import event_table

EFFICIENCY = Efficiency(5.0, 13.0)
DIMER = pd.DataFrame({"concentration_nm": [3.0, 10.0, 30.0, 100.0]})
PARTNERS = pd.DataFrame({"a_nm": [20.0, 20.0, 60.0, 20.0], "b_nm": [5.0, 40.0, 60.0, 0.0]})


@pytest.mark.parametrize("total", [1e-4, 1.0, 1e4])
def test_monomers_and_dimers_obey_mass_action(total: float) -> None:
    (monomer, dimer), *_ = at_equilibrium("dimer", np.array([[total]]), 10.0)
    assert monomer + 2 * dimer == pytest.approx(total, rel=1e-12)
    assert monomer**2 / dimer == pytest.approx(10.0, rel=1e-9)


@pytest.mark.parametrize("totals", [(1e-4, 1.0), (20.0, 20.0), (1e4, 3.0)])
def test_partners_obey_mass_action(totals: tuple[float, float]) -> None:
    (a, b, both), *_ = at_equilibrium("ab", np.array([totals]), 25.0)
    assert a + both == pytest.approx(totals[0], rel=1e-9)
    assert b + both == pytest.approx(totals[1], rel=1e-9)
    bound = brentq(lambda x: (totals[0] - x) * (totals[1] - x) - 25 * x, 0, min(totals), xtol=1e-15)
    assert both == pytest.approx(bound, rel=1e-6)


def test_an_inactive_part_stays_as_it_is() -> None:
    (monomer, dimer), *_ = at_equilibrium("dimer", np.array([[100.0]]), 10.0, inactive=0.2)
    assert monomer + 2 * dimer == pytest.approx(100.0)
    assert (monomer - 20) ** 2 / dimer == pytest.approx(10.0)
    assert at_equilibrium("ab", np.array([[10.0, 0.0]]), 5.0).min() > 0


def test_landings_follow_the_power() -> None:
    masses = COMPOSITION["dimer"] @ np.array([66.0])
    same = landing_logits("dimer", np.array([[10.0]]), 10.0, 0.0, masses, 0.0)
    less = landing_logits("dimer", np.array([[10.0]]), 10.0, 0.0, masses, LANDING_POWER)
    assert np.exp(less - same)[0] == pytest.approx([1.0, 2 ** (-1 / 6)])


@pytest.mark.parametrize("model", ["dimer", "ab"])
@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("weights", ["free", "equilibrium"])
def test_the_likelihood_has_the_slope_and_bend_that_differences_give(
    model: Model, known: bool, weights: str
) -> None:
    random = np.random.default_rng(5)
    samples, masses = (DIMER, [66.0]) if model == "dimer" else (PARTNERS[:3], [80.0, 150.0])
    totals = samples.to_numpy(float)
    tables = draw_series(random, model, totals, 10.0, masses, number=150, efficiency=EFFICIENCY)
    events = [event_table(table).events for table in tables]
    if not known:  # neither the errors nor what was missed
        events = [Events(one.x, np.ones(one.x.size), None) for one in events]
    series = Series(events, COMPOSITION[model], np.array(masses))
    equilibrium = _Equilibrium(series, totals, model, None, True)
    problem = series.problem() if weights == "free" else equilibrium.problem()
    first = series.first if weights == "free" else equilibrium.first
    theta = first + 0.02 * problem.scale * random.normal(size=first.size)
    value, slope = problem.height(theta)
    assert np.isfinite(value)
    step = 1e-4
    steps = np.diag(step * problem.scale)
    moved = [(problem.height(theta + h), problem.height(theta - h)) for h in steps]
    numerical = [(above[0] - below[0]) / (2 * step) for above, below in moved]
    assert slope * problem.scale == pytest.approx(np.array(numerical), rel=1e-5, abs=1e-4)
    bends = np.array([(below[1] - above[1]) / (2 * step) for above, below in moved])
    scale = np.outer(problem.scale, problem.scale)
    expected = bends * problem.scale
    size = np.sqrt(np.outer(np.abs(np.diag(expected)), np.abs(np.diag(expected))))
    assert np.all(np.abs(problem.curvature(theta) * scale - expected) < 2e-3 * size + 1e-3)


def test_a_maximum_is_found_at_a_limit_and_beside_a_saddle() -> None:
    """Rosenbrock's valley, free and with a wall across it, and two peaks from between them."""

    def valley(theta):
        x, y = theta
        slope = np.array([2 * (1 - x) + 400 * x * (y - x * x), -200 * (y - x * x)])
        return -((1 - x) ** 2) - 100 * (y - x * x) ** 2, slope

    def peaks(theta):
        x, y = theta
        return -((x**2 - 1) ** 2) - y**2, np.array([-4 * x * (x**2 - 1), -2 * y])

    one = np.ones(2)
    problem = Problem(valley, -5 * one, 5 * one, one, events=1000)
    assert maximise(problem, np.array([-1.2, 1.0])).theta == pytest.approx([1, 1], abs=2e-2)
    walled = maximise(replace(problem, high=np.array([0.5, 5.0])), np.array([-1.2, 1.0]))
    assert walled.theta == pytest.approx([0.5, 0.25], abs=1e-3)
    assert walled.free.tolist() == [False, True]
    assert walled.covariance() == pytest.approx(np.diag([0, 1 / 200]))
    both = Problem(peaks, -5 * one, 5 * one, one)
    assert maximise(both, np.array([0.01, 3.0])).theta == pytest.approx([1, 0], abs=2e-2)


@pytest.mark.parametrize("tail", [0.05, 0.5, 1.0, 2.0])
def test_a_peak_with_a_tail_is_nearly_the_exponentially_modified_normal(tail: float) -> None:
    d, width = np.linspace(-40.0, 90.0, 100), 9.0
    means, widths = tail * width * MEANS, width * np.sqrt(1 + tail**2 * VARIANCES)
    own = norm.pdf(d[:, None], means, widths) @ SHARES
    exact = exponnorm.pdf(d, tail, 0, width)
    assert np.abs(own - exact).max() < (0.005 + 0.01 * tail**2) * exact.max()
    assert SHARES @ means == pytest.approx(tail * width)


def drawn(
    seed: int | list[int], mass_kda: float, number: int, kd_nm: float = 10.0, **more: Any
) -> list[pd.DataFrame]:
    totals, random = DIMER.to_numpy(float), np.random.default_rng(seed)
    return draw_series(random, "dimer", totals, kd_nm, [mass_kda], number=number, **more)


@pytest.fixture(scope="module")
def dimers() -> list[pd.DataFrame]:
    return drawn(6, 66.0, 900, efficiency=EFFICIENCY)


@pytest.fixture(scope="module")
def free(dimers) -> ia.Binding:
    """Fit K_D and the exponent of the landings."""
    return ia.fit_kd(DIMER, tables=dimers, model="dimer", masses_kda=[66.0])


@pytest.fixture(scope="module")
def held(dimers) -> ia.Binding:
    """Fit K_D alone."""
    return ia.fit_kd(
        DIMER, tables=dimers, model="dimer", masses_kda=[66.0], landing_power=LANDING_POWER
    )


def test_kd_is_found_and_its_ends_are_where_the_profile_says(dimers) -> None:
    found = ia.fit_kd(DIMER, tables=dimers, model="dimer")
    assert any("the monomer was taken for the peak at" in note for note in found.notes)
    fit = found.fit
    assert fit.kd_low < 10 < fit.kd_high
    assert fit.kd_high / fit.kd_low < 2.3  # and 1.6 where the landing exponent is known
    assert fit.masses_kda == pytest.approx([66.0, 132.0], abs=1.0)
    assert fit.p_value > 0.01
    assert fit.dof == 3
    assert fit.profile_ln_kd[[0, -1]] == pytest.approx(np.log([fit.kd_low, fit.kd_high]))
    assert fit.profile_deviance[[0, -1]] == pytest.approx(3.8415, abs=0.01)
    assert fit.profile_deviance.min() == pytest.approx(0.0, abs=1e-3)
    assert found.samples["complexes"].is_monotonic_increasing
    assert np.all(np.abs(found.samples["pull"]) < 4)
    assert found.curve["complexes"].is_monotonic_increasing


@pytest.mark.parametrize("seed", [2, 4, 15])
def test_ends_are_on_the_profile_where_events_are_few(seed: int) -> None:
    """Sixty events a table, for which the errors of MINOS end elsewhere."""
    tables = drawn([91, seed], 66.0, 60)
    fit = ia.fit_kd(DIMER, tables=tables, model="dimer", masses_kda=[64.0]).fit
    assert fit.kd_low < fit.kd_nm < fit.kd_high
    assert fit.profile_ln_kd[[0, -1]] == pytest.approx(np.log([fit.kd_low, fit.kd_high]))
    assert fit.profile_deviance[[0, -1]] == pytest.approx(3.8415, abs=0.01)


def test_parameters_that_are_no_numbers_have_no_likelihood() -> None:
    x, noise, weight = np.linspace(50, 80, 40), np.full(40, 25.0), np.ones(1)
    value, slopes = mixture_score(x, noise, (weight, np.array([np.nan]), np.array([4.0])))
    assert np.isnan(value)
    assert np.isnan(slopes).any()


def test_landings_that_are_taken_alike_change_kd(dimers, held) -> None:
    alike = ia.fit_kd(DIMER, tables=dimers, model="dimer", masses_kda=[66.0], landing_power=0.0).fit
    assert alike.kd_nm > 1.1 * held.fit.kd_nm


def test_a_mass_in_another_unit_is_refused(dimers) -> None:
    with pytest.raises(ia.DataError, match="no event is near the masses"):
        ia.fit_kd(DIMER, tables=dimers, model="dimer", masses_kda=[66e3])


def test_a_monomer_that_is_hardly_detected_gives_no_kd() -> None:
    """Of monomers of 40 kDa one in a hundred passes 65 kDa."""
    tables = drawn(12, 40.0, 1000)
    seen = [table[table["mass_kda"] > 65][["mass_kda"]].head(200) for table in tables]
    with pytest.raises(ia.DataError, match=r"of the species of about .* K_D is not determined"):
        ia.fit_kd(DIMER, tables=seen, model="dimer", masses_kda=[40.0])


def test_the_monomer_is_taken_from_two_peaks() -> None:
    """40 kDa explained peaks at 80 and 160 kDa as well, and were taken."""
    found = ia.fit_kd(DIMER, tables=drawn(10, 80.0, 600), model="dimer")
    assert found.fit.masses_kda == pytest.approx([80, 160], abs=2)
    assert found.fit.kd_low < 10 < found.fit.kd_high
    (note,) = [note for note in found.notes if "the monomer was taken" in note]
    peaks = [float(number) for number in re.findall(r"([0-9.]+) kDa", note)]
    assert peaks == pytest.approx([80, 160], abs=6)


@pytest.mark.parametrize("seed", [1, 3])
def test_dimers_may_be_twice_as_wide_as_monomers(seed: int) -> None:
    """The common width of both was that of monomers, and dimers' tails were background."""
    random, kd_nm = np.random.default_rng([61, seed]), 8.35
    totals = 2.0 ** np.arange(7.0)[:, None]
    tables = []
    for monomer, dimer in at_equilibrium("dimer", totals, kd_nm) * [1, 2**LANDING_POWER]:
        is_dimer = random.random(600) < dimer / (monomer + dimer)
        mass = random.normal(np.where(is_dimer, 160.0, 80.0), np.where(is_dimer, 25.3, 12.7))
        tables.append(pd.DataFrame({"mass_kda": mass}))
    samples = pd.DataFrame({"concentration_nm": totals[:, 0]})
    fit = ia.fit_kd(samples, tables=tables, model="dimer", masses_kda=[80.0]).fit
    assert fit.kd_low < kd_nm < fit.kd_high < 3 * fit.kd_low
    assert fit.masses_kda == pytest.approx([80, 160], abs=4)


def test_peaks_that_are_no_ladder_need_the_mass() -> None:
    tables = drawn(11, 80.0, 300, 1e-5)
    with pytest.raises(ia.DataError, match=r"which peak .* is the monomer cannot be told.*160 kDa"):
        ia.fit_kd(DIMER, tables=tables, model="dimer")


def test_an_exponent_that_is_held_makes_the_interval_narrower(free, held) -> None:
    assert held.fit.landing_power == LANDING_POWER
    assert held.fit.landing_power_se == 0
    assert 0.05 < free.fit.landing_power_se < 0.17
    assert held.fit.kd_high / held.fit.kd_low < 0.85 * free.fit.kd_high / free.fit.kd_low


def test_two_partners() -> None:
    random = np.random.default_rng(7)
    totals = PARTNERS.to_numpy(float)
    tables = draw_series(random, "ab", totals, 25.0, [80.0, 150.0], number=900)
    found = ia.fit_kd(PARTNERS, tables=tables, model="ab", masses_kda=[78.0, 152.0])
    assert found.fit.kd_low < 25 < found.fit.kd_high
    assert found.fit.masses_kda == pytest.approx([80, 150, 230], abs=1.5)
    assert found.curve.empty


def test_an_inactive_part_is_told_and_fitted() -> None:
    random = np.random.default_rng(8)
    totals = np.array([[1.0], [10], [100], [300]])
    samples = pd.DataFrame({"concentration_nm": totals[:, 0]})
    tables = draw_series(random, "dimer", totals, 10.0, [66.0], number=600, inactive=0.3)
    plain = ia.fit_kd(samples, tables=tables, model="dimer", masses_kda=[66.0])
    assert plain.fit.inactive_p < 1e-3
    assert any("inactive part" in note for note in plain.notes)
    right = ia.fit_kd(samples, tables=tables, model="dimer", masses_kda=[66.0], inactive=True)
    assert right.fit.inactive == pytest.approx(0.3, abs=0.05)
    assert right.fit.kd_low < 10 < right.fit.kd_high


def test_an_end_that_the_data_do_not_set_is_open() -> None:
    random = np.random.default_rng(9)
    table = draw_series(random, "dimer", np.array([[0.001]]), 1e4, [66.0], number=200)[0]
    found = ia.fit_kd(
        pd.DataFrame({"concentration_nm": [1.0]}), tables=[table], model="dimer", masses_kda=[66.0]
    )
    assert found.fit.kd_high == np.inf
    assert found.fit.kd_low > 1
    assert any("higher concentrations" in note for note in found.notes)


def test_samples_are_read_and_results_written(dimers, free, tmp_path: Path) -> None:
    for number, table in enumerate(dimers):
        table.to_csv(tmp_path / f"{number}.csv", index=False)
    rows = DIMER.assign(path=[f"{n}.csv" for n in range(4)], replicate=1, role="sample")
    rows.loc[4] = [np.nan, "blank.csv", 1, "blank"]
    rows.to_csv(tmp_path / "samples.csv", index=False)
    out = tmp_path / "out"
    found = ia.fit_kd(tmp_path / "samples.csv", model="dimer", masses_kda=[66.0], out=out)
    assert found.fit.kd_nm == pytest.approx(free.fit.kd_nm, rel=1e-6)
    assert sorted(path.name for path in out.iterdir()) == [
        ".iscat-files", "kd.csv", "kd.html", "kd.json",
    ]  # fmt: skip
    assert json.loads((out / "kd.json").read_text())["kd_nm"] == pytest.approx(found.fit.kd_nm)
    assert list(pd.read_csv(out / "kd.csv")["replicate"]) == [1] * 4
    shown = pd.DataFrame(figures_in(out / "kd.html")["kd"].data["rows"])
    points = shown[shown["kind"] == "point"]
    np.testing.assert_allclose(points["y"], found.samples["complexes"], rtol=1e-5)


def test_samples_are_read_as_the_table_of_a_day_is(dimers, tmp_path: Path) -> None:
    lines = ["# of Monday, 3 buffers", "path;buffer, pH;concentration_nm", ""]
    for number, (table, given) in enumerate(zip(dimers, DIMER["concentration_nm"], strict=True)):
        table.to_csv(tmp_path / f"#{number}.csv", index=False)
        lines.append(f"run#{number}/../#{number}.csv;PBS, 7.4;{given}")
        (tmp_path / f"run#{number}").mkdir()
    samples = tmp_path / "samples.csv"
    samples.write_text("\n".join(lines))
    found = ia.fit_kd(samples, model="dimer", masses_kda=[66.0])
    assert list(found.samples["buffer, pH"]) == ["PBS, 7.4"] * 4
    assert [row.given for row in read_table(samples).rows] == list(found.samples["path"])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"model": "trimer"}, "choose one of dimer, ab"),
        ({"model": "ab"}, "needs the masses of A and B"),
        ({"model": "dimer", "masses_kda": [66.0, 80.0]}, "takes the mass of the monomer"),
        ({"model": "ab", "masses_kda": [66.0]}, "takes those of A and B"),
        ({"model": "ab", "masses_kda": [66.0, -1.0]}, "= -1: give one mass in kDa above 0"),
        ({"model": ["dimer"]}, "choose one of dimer, ab"),
        ({"model": "dimer", "masses_kda": "66"}, "takes the mass of the monomer"),
        ({"model": "dimer", "inactive": "yes"}, "`inactive` = 'yes': give True or False"),
        ({"model": "dimer", "landing_power": 5.0}, "between -1 and 1"),
    ],
)
def test_impossible_options_are_refused(options: dict, said: str, dimers) -> None:
    with pytest.raises(ia.ConfigError, match=said):
        ia.fit_kd(DIMER, tables=dimers, **options)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no CSV file"),
        ("path\n0.csv\n", "no column concentration_nm"),
        ("concentration_nm\n3\n", "no column path"),
        ("path,concentration_nm\n0.csv,-3\n", "row 1 has no concentration above 0"),
        ("path,concentration_nm\n0.csv,x\n", "no number"),
        ("path,concentration_nm,role\n0.csv,3,blank\n", "no row of a sample"),
        ("path,concentration_nm\nnone.csv,3\n", "none.csv: cannot be read"),
    ],
)
def test_wrong_samples_are_refused(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "samples.csv"
    path.write_text(text)
    with pytest.raises(ia.DataError, match=said):
        ia.fit_kd(path, model="dimer")
