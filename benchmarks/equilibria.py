"""K_D of many simulated series: how far it is off, and how often its interval holds the truth.

    python benchmarks/equilibria.py [--trials N] [--only KIND]

A series is six tables of 600 events, 1 to 300 nM of a monomer of 66 kDa with K_D = 10 nM.  In each
kind there is one thing that the tables of a laboratory may have: see `KINDS`.  The fit is told that
the monomer has about 64 kDa.  The landing exponent is fitted with what is known of it, −1/6 ± 1/6.

A series' K_D is off by its logarithm over the truth.  Beside the mean over series stand its
standard error, the scatter of the series, and the standard error that the intervals claim, which
includes that of the exponent: series of which all have the same exponent scatter less.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402  # after the thread counts
import pandas as pd  # noqa: E402

import iscat_analysis as ia  # noqa: E402
from iscat_analysis.species.equilibrium import LANDING_POWER, at_equilibrium  # noqa: E402

RESULTS = Path(__file__).resolve().parent / "results"
TOTALS_NM = np.array([1.0, 3.0, 10.0, 30.0, 100.0, 300.0])
KD_NM, MONOMER_KDA, EVENTS, DRAWN = 10.0, 66.0, 600, 3000
LEAST_COVERED = 0.90


@dataclass(frozen=True)
class Kind:
    """How the events of a series differ from normal peaks that are all seen."""

    sigma_kda: tuple[float, float] | None = None  # errors that the table gives; else none, and 12
    limit_kda: float = -math.inf  # of detection, 8 kDa soft
    tail_kda: float = 0.0  # mean of an exponential that is added
    uniform: float = 0.0  # share of events anywhere from 20 to 600 kDa
    aggregates: float = 0.0  # share of particles of 3 to 8 monomers
    growth: float = 0.0  # power of the mass with which widths grow
    power: float = LANDING_POWER


KINDS = {
    "errors": Kind(sigma_kda=(6.0, 12.0)),
    "limit": Kind(limit_kda=65.0),
    "tail": Kind(tail_kda=12.0),
    "uniform": Kind(uniform=0.25),
    "aggregates": Kind(aggregates=0.1),
    "landing": Kind(power=0.0),
    "wide": Kind(growth=1.0),
    "wide, landing": Kind(growth=1.0, power=0.0),
}


def draw(random: np.random.Generator, kind: Kind) -> list[pd.DataFrame]:
    """Draw the tables of a series."""
    tables = []
    for total in TOTALS_NM:
        rates = at_equilibrium("dimer", np.array([[total]]), KD_NM)[0] * [1, 2**kind.power]
        copies = 1.0 + (random.random(DRAWN) < rates[1] / rates.sum())
        aggregated = random.random(DRAWN) < kind.aggregates
        true = MONOMER_KDA * np.where(aggregated, random.integers(3, 9, DRAWN), copies)
        true += random.exponential(kind.tail_kda, DRAWN)
        sigma = np.full(DRAWN, 12.0)
        if kind.sigma_kda:
            true, sigma = random.normal(true, 3.0), random.uniform(*kind.sigma_kda, DRAWN)
        mass = random.normal(true, sigma * copies**kind.growth)
        elsewhere = random.random(DRAWN) < kind.uniform
        mass = np.where(elsewhere, random.uniform(20, 600, DRAWN), mass)
        seen = (mass > 0) & (random.normal(mass, 8.0) > kind.limit_kda)
        table = pd.DataFrame({"mass_kda": mass, "sigma_mass_kda": sigma})[seen].head(EVENTS)
        tables.append(table if kind.sigma_kda else table[["mass_kda"]])
    return tables


def run(name: str, trials: int) -> dict[str, Any]:
    """Fit so many series of a kind."""
    samples = pd.DataFrame({"concentration_nm": TOTALS_NM})
    ln_kd, low, high, powers, seconds = [], [], [], [], []
    for seed in range(trials):
        tables = draw(np.random.default_rng([94, list(KINDS).index(name), seed]), KINDS[name])
        started = time.process_time()
        fit = ia.fit_kd(samples, tables=tables, model="dimer", masses_kda=[64.0]).fit
        seconds.append(time.process_time() - started)
        ln_kd.append(math.log(fit.kd_nm / KD_NM))
        low.append(fit.kd_low)
        high.append(fit.kd_high)
        powers.append(fit.landing_power)
    covered = float(np.mean((np.array(low) < KD_NM) & (np.array(high) > KD_NM)))
    claimed = np.log(np.array(high) / np.maximum(low, 1e-9)) / (2 * 1.96)
    return {
        "trials": trials,
        "bias": float(np.mean(ln_kd)),
        "bias_se": float(np.std(ln_kd, ddof=1) / math.sqrt(trials)),
        "scatter": float(np.std(ln_kd, ddof=1)),
        "claimed": float(np.median(claimed)),
        "covered": covered,
        "covered_se": math.sqrt(max(covered * (1 - covered), 0.05 * 0.95) / trials),
        "power": float(np.mean(powers)),
        "processor_seconds": float(np.median(seconds)),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description="K_D of many simulated series.")
    parser.add_argument("--trials", type=int, default=100, help="series of each kind")
    parser.add_argument("--quick", action="store_true", help="10 series of each kind")
    parser.add_argument("--only", choices=KINDS, help="one kind")
    options = parser.parse_args()
    trials = 10 if options.quick else options.trials
    found = {}
    for name in [options.only] if options.only else KINDS:
        found[name] = one = run(name, trials)
        print(
            f"{name:<12}K_D {100 * one['bias']:+5.1f} ± {one['bias_se'] * 100:.1f} %, scatter "
            f"{100 * one['scatter']:.1f} % (claimed {100 * one['claimed']:.1f}), covered "
            f"{100 * one['covered']:.0f} ± {100 * one['covered_se']:.1f} %, exponent "
            f"{one['power']:+.3f}, {one['processor_seconds']:.2f} s",
            flush=True,
        )
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "equilibria.json").write_text(json.dumps(found, indent=2) + "\n")
    return int(
        any(one["covered"] < LEAST_COVERED - 4 * one["covered_se"] for one in found.values())
    )


if __name__ == "__main__":
    sys.exit(main())
