"""Species of many movies: matched, averaged over replicates, compared between samples."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest

from iscat_analysis.day.compare import holm, match_species, sample_means, shifts
from iscat_analysis.day.gather import poisson_rate, shares_of

# Standard errors of a share of rejections in so many repetitions.
FAR = 4.0


def _species(rows: list[tuple[str, str, float, float]]) -> pd.DataFrame:
    """Make a table of movie, sample, mass and its standard error."""
    table = pd.DataFrame(rows, columns=["movie", "sample", "mass_kda", "mass_se"])
    return table.assign(condition="", outlier=False, share=0.5, share_low=0.4, share_high=0.6)


def test_species_of_one_mass_are_one_kind() -> None:
    table = _species(
        [("a", "s", 66, 1), ("a", "s", 132, 1), ("b", "s", 68, 1), ("b", "s", 480, 4),
         ("c", "s", 130, 1), ("c", "s", 64, 1)]
    )  # fmt: skip
    assert match_species(table)["kind"].tolist() == [1, 2, 1, 3, 2, 1]


def test_two_species_of_one_movie_are_never_one_kind() -> None:
    table = _species([("a", "s", 100, 5), ("a", "s", 104, 5), ("b", "s", 102, 5)])
    kinds = match_species(table)["kind"].tolist()
    assert kinds[0] != kinds[1]
    assert kinds[2] in kinds[:2]


def test_a_kind_does_not_creep_along_a_ladder_of_masses() -> None:
    masses = 100 * 1.06 ** np.arange(12)
    table = _species([(f"m{k}", "s", mass, 0.5) for k, mass in enumerate(masses)])
    matched = match_species(table)
    spread = matched.groupby("kind")["mass_kda"].agg(lambda m: m.max() / m.min())
    assert spread.max() < 1.2


def test_outliers_are_no_kind() -> None:
    table = _species([("a", "s", 66, 1), ("b", "s", 67, 1)])
    table.loc[1, "outlier"] = True
    assert match_species(table)["kind"].tolist() == [1, 0]
    assert match_species(table[:0])["kind"].tolist() == []


def test_equal_movies_have_the_error_of_their_counts() -> None:
    means = sample_means(np.array([10.0, 10.0, 20.0]), np.array([1.0, 1.0, 2.0]), [0, 0, 1])
    assert means.value == pytest.approx([10.0, 20.0])
    assert means.se == pytest.approx([1 / math.sqrt(2), 2.0])
    assert (means.scatter, means.freedom) == (0.0, math.inf)


def test_scatter_between_movies_is_measured() -> None:
    """DerSimonian and Laird by hand: two samples of two movies, 10 ± 5 apart, errors of 1.

    Q = 4·25 = 100 with 2 degrees of freedom, C = 4 − 2 = 2, so τ² = 98/2 = 49.
    """
    means = sample_means(np.array([0.0, 10.0, 20.0, 30.0]), np.ones(4), [0, 0, 1, 1])
    assert means.scatter == pytest.approx(7.0)
    assert means.freedom == 2
    assert means.se == pytest.approx([5.0, 5.0])


def test_a_movie_without_an_error_is_left_out() -> None:
    means = sample_means(np.array([1.0, 99.0, 2.0]), np.array([1.0, 0.0, math.nan]), [0, 0, 1])
    assert means.value[0] == 1.0
    assert math.isnan(means.value[1])
    assert means.movies.tolist() == [1.0, 0.0]


@pytest.mark.parametrize(
    ("scatter", "samples", "movies"),
    [(0, 4, 1), *(pytest.param(*one, marks=pytest.mark.large) for one in ((1, 6, 3), (3, 2, 3)))],
)
def test_equal_samples_are_rarely_found_to_differ(
    scatter: float, samples: int, movies: int, repetitions
) -> None:
    rng = np.random.default_rng(1)
    trials = repetitions(150, 4000)
    number = np.repeat(np.arange(samples), movies)
    found = 0
    for _ in range(trials):
        se = rng.uniform(0.5, 1.5, number.size)
        mass = 100 + np.hypot(scatter, se) * rng.standard_normal(number.size)
        rows = zip(number, mass, se, strict=True)
        table = _species([(f"m{k}", f"s{n}", m, s) for k, (n, m, s) in enumerate(rows)])
        table = table.assign(kind=1)
        compared = shifts(table, "s0")
        masses = compared[(compared["quantity"] == "mass_kda") & (compared["sample"] == "s1")]
        found += float(masses["p_value"].iloc[0]) < 0.05
    # With scatter as large as the errors, 2000 repetitions of six samples found 6.2 %.
    assert found / trials < 0.07 + FAR * math.sqrt(0.07 * 0.93 / trials)


def test_a_shift_is_found_and_has_its_interval() -> None:
    rows = [
        (f"{s}{k}", s, m + d, 1.0)
        for s, m in (("a", 100), ("b", 110))
        for k, d in enumerate((-1, 0, 1))
    ]
    table = _species(rows).assign(kind=1)
    row = shifts(table, "a").query("quantity == 'mass_kda' and sample == 'b'").iloc[0]
    assert row["shift"] == pytest.approx(10.0)
    assert row["shift_se"] == pytest.approx(math.sqrt(2 / 3))
    assert row["shift_low"] == pytest.approx(10 - 1.959964 * math.sqrt(2 / 3))
    assert row["p_value"] < 1e-20
    assert row["p_holm"] == 2 * row["p_value"]  # mass and share are compared
    own = shifts(table, "a").query("quantity == 'mass_kda' and sample == 'a'").iloc[0]
    assert math.isnan(own["shift"])


def test_without_the_reference_nothing_is_compared() -> None:
    table = _species([("a0", "a", 100, 1), ("b0", "b", 110, 1)]).assign(kind=1)
    assert shifts(table, "z")["shift"].isna().all()
    assert shifts(table[:0], "a").empty


def test_holm_by_hand() -> None:
    found = holm(np.array([0.01, math.nan, 0.04, 0.03]))
    assert found[[0, 2, 3]] == pytest.approx([0.03, 0.06, 0.06])
    assert math.isnan(found[1])


def test_rates_have_poisson_intervals() -> None:
    """Garwood's interval of 10 counts is 4.795 to 18.390."""
    rate, low, high = poisson_rate(10, 2.0)
    assert (rate, low, high) == pytest.approx((5.0, 4.7954 / 2, 18.3904 / 2), rel=1e-4)
    assert poisson_rate(0, 1.0)[:2] == (0.0, 0.0)
    assert all(math.isnan(value) for value in poisson_rate(10, math.nan))


def _counted(seen: float, efficiency: float, *, outlier: bool = False) -> dict[str, float]:
    half = 1.96 * math.sqrt(seen)
    return {
        "outlier": outlier, "count": seen, "count_low": seen - half, "count_high": seen + half,
        "count_corrected": seen / efficiency,
    }  # fmt: skip


def test_shares_leave_out_what_lies_apart() -> None:
    """100 and 50 seen of 100 %, and of 50 %, are as many; one at 1e-6 does not take it all."""
    shares = shares_of([_counted(100, 1.0), _counted(50, 0.5), _counted(1, 1e-6, outlier=True)])
    assert [s["share"] for s in shares[:2]] == pytest.approx([0.5, 0.5])
    assert math.isnan(shares[2]["share"])
    # Log odds of counts 100 and 50 have the variance 1/100 + 1/50.
    reach = 1.96 * math.sqrt(0.03)
    assert shares[0]["share_high"] == pytest.approx(1 / (1 + math.exp(-reach)), rel=1e-4)
    assert shares[0]["share_low"] == pytest.approx(1 - shares[0]["share_high"], rel=1e-4)


def test_a_single_species_has_the_whole_share() -> None:
    assert shares_of([_counted(100, 1.0)]) == [{"share": 1.0}]
