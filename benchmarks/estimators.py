"""The promises about estimators, on enough trials to hold them to one another.

    python benchmarks/estimators.py [--quick] [--seed N]

Efficiency: 10 000 fits in every mode and scheme at 3000 collected scattered photons; spread over
CRB within 3 % (four standard errors), bias below a twentieth of the bound, failures below one in a
thousand, good data called a poor fit as often as stated.  Heights: 10 000 fits with z anywhere in
[0, 1 µm]; silent wrong fringes below one in a thousand.  Few photons: where the spread leaves the
bound, and that nothing silent is 6 σ off.  Posteriors: ranks of 520 truths, and under a wrong gain.
Exit status 1 where a promise is broken; ``--quick`` takes fewer trials, of which some are off, and
judges nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from itertools import product
from pathlib import Path
from typing import Any

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

ROOT = Path(__file__).resolve().parent
sys.path.insert(0, str(ROOT.parent / "tests"))

import numpy as np  # noqa: E402  # after the thread counts
from microscopes import setting  # noqa: E402

from iscat_analysis.inference.fit import POOR_FIT_P  # noqa: E402
from iscat_analysis.records import PARAMETERS, Status  # noqa: E402
from iscat_analysis.study import calibrate_posterior, run_trials, score  # noqa: E402

RESULTS = ROOT / "results"
SCHEMES, MODES = ("iscat", "cobri", "darkfield"), ("mass", "localize", "joint")
EFFICIENT = (0.97, 1.03)
BIAS_SHARE, FAILURES, WRONG_FRINGES, FAR = 0.05, 1e-3, 1e-3, 6.0
LEAVES = 1.1  # spread over CRB that counts as leaving the bound
FEW = (100.0, 300.0, 1000.0, 3000.0)
UNIFORM, REJECTED = 1e-3, 1e-6


class Report:
    """Numbers, and which promises they break."""

    def __init__(self, quick: bool, seed: int, workers: int) -> None:
        self.numbers: dict[str, Any] = {}
        self.broken: list[str] = []
        self.quick, self.seed, self.workers = quick, seed, workers

    def trials(self, full: int) -> int:
        """Take a twentieth of the trials for a quick look."""
        return max(full // 20, 40) if self.quick else full

    def promise(self, kept: bool, text: str) -> None:
        """Book one promise."""
        broken = "off     " if self.quick else "BROKEN  "
        print(("ok      " if kept else broken) + text, flush=True)
        if not kept:
            self.broken.append(text)


def efficiency(report: Report) -> None:
    count = report.trials(10_000)
    flagged = dict.fromkeys(SCHEMES, 0)
    for number, (scheme, mode) in enumerate(product(SCHEMES, MODES)):
        experiment = setting(scheme, mode)
        found = run_trials(
            experiment, count, seed=report.seed, stream=100 + number, workers=report.workers
        )
        bounds, kept = experiment.bounds, found.usable
        rate = float(np.mean(found.failed))
        flagged[scheme] += int(found.flagged(Status.POOR_FIT).sum())
        report.promise(rate < FAILURES, f"{scheme} {mode}: failures {rate:.2%} of {count}")
        for name in experiment.free:
            k = PARAMETERS.index(name)
            error = (found.estimate - found.truth)[kept, k]
            s = score(error, found.sigma[kept, k], bounds.crb_joint[k], bounds.qcrb[k])
            report.numbers[f"{scheme}.{mode}.{name}"] = s.plain()
            low, high = s.spread_over_crb_ci95
            report.promise(
                EFFICIENT[0] <= s.spread_over_crb <= EFFICIENT[1]
                and abs(s.bias) < BIAS_SHARE * s.crb,
                f"{scheme} {mode} {name}: spread/CRB {s.spread_over_crb:.4f} "
                f"[{low:.3f}, {high:.3f}], bias {s.bias / s.crb:+.3f} ± "
                f"{s.bias_se / s.crb:.3f} CRB, pull {s.pull_std:.3f}, "
                f"inside σ {s.coverage68:.3f}",
            )
    judged = count * len(MODES)
    for scheme, times in flagged.items():
        share, error = times / judged, np.sqrt(POOR_FIT_P / judged)
        report.numbers[f"{scheme}.poor_fit_share"] = share
        report.promise(
            abs(share - POOR_FIT_P) < 4 * error,
            f"{scheme}: good data called a poor fit: {share:.2e} of {judged}, "
            f"nominal {POOR_FIT_P:.0e}",
        )


def heights(report: Report) -> None:
    count = report.trials(10_000)
    for mode in ("joint", "localize"):
        experiment = setting("iscat", mode, z_nm=500.0)
        truths = np.tile(experiment.truth, (count, 1))
        truths[:, 2] = np.random.default_rng(report.seed).uniform(0, 1000, count)
        found = run_trials(
            experiment, count, seed=report.seed, stream=1, workers=report.workers, truths=truths
        )
        wrong = np.abs(found.estimate - truths)[:, 2] > experiment.context.model.fringe_nm / 4
        silent = int(np.sum(wrong & found.unflagged))
        report.numbers[f"heights.{mode}"] = {
            "trials": count, "wrong": int(wrong.sum()), "silent": silent,
            "ambiguous": int(found.flagged(Status.AMBIGUOUS_Z).sum()),
        }  # fmt: skip
        report.promise(
            silent <= WRONG_FRINGES * count,
            f"{mode}: {silent} silent wrong fringes in {count}, {int(wrong.sum())} wrong in all",
        )


def few_photons(report: Report) -> None:
    count = report.trials(1000)
    for scheme in SCHEMES:
        for mode in MODES:
            left = {}
            for number, photons in enumerate(FEW):
                experiment = setting(scheme, mode, photons=photons, z_nm=200.0)
                found = run_trials(
                    experiment, count, seed=report.seed, stream=10 + number, workers=report.workers
                )
                kept, bound = found.unflagged, experiment.bounds.crb_joint
                error = (found.estimate - found.truth)[kept]
                ratio = {
                    name: float(np.std(error[:, k]) / bound[k])
                    for name in experiment.free
                    for k in (PARAMETERS.index(name),)
                }
                pull = np.abs(error) / found.sigma[kept]
                far = int(np.sum(np.nanmax(pull, axis=1) > FAR))
                report.numbers[f"few.{scheme}.{mode}.{photons:g}"] = {
                    "spread_over_crb": ratio, "flagged": int(np.sum(~kept)), "silent_far": far,
                }  # fmt: skip
                for name, value in ratio.items():
                    if value > LEAVES:
                        left[name] = (photons, round(value, 2))
                if photons >= 300:
                    report.promise(
                        far == 0, f"{scheme} {mode} {photons:g} photons: {far} silent beyond 6 σ"
                    )
            print(f"        {scheme} {mode}: leaves the bound at {left or 'none of these'}")


def posteriors(report: Report) -> None:
    experiment = setting("iscat", "joint", fit={"roi_nm": 1350.0})
    width = np.array([100.0, 100.0, 12.0, 0.0])
    lower, upper = experiment.truth - width, experiment.truth + width
    lower[3], upper[3] = 500.0, 2000.0
    for gain, count in ((1.0, report.trials(520)), (0.5, report.trials(520))):
        found = calibrate_posterior(
            experiment, count, lower=lower, upper=upper, seed=report.seed, gain=gain,
            workers=report.workers,
        )  # fmt: skip
        p_values = found.p_values(20 if count >= 200 else 5)
        kept = found.kept
        report.numbers[f"posteriors.gain_{gain:g}"] = {
            "draws": count, "refused": found.refused, "p_values": p_values,
            "width_over_crb": np.mean(found.width_over_crb[kept], axis=0).tolist(),
            "inside68": np.mean(found.inside68[kept], axis=0).tolist(),
            "inside95": np.mean(found.inside95[kept], axis=0).tolist(),
        }  # fmt: skip
        text = ", ".join(f"{name} {p:.2g}" for name, p in p_values.items())
        if gain == 1:
            good = min(p_values.values()) > UNIFORM
            report.promise(good, f"ranks of {count - found.refused} truths are uniform: {text}")
        else:
            seen = min(p_values.values()) < REJECTED
            report.promise(seen, f"ranks under a wrong gain are rejected: {text}")


def main() -> int:
    parser = argparse.ArgumentParser(description="What the estimators promise.")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--seed", type=int, default=2021)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--only", choices=["efficiency", "heights", "few_photons", "posteriors"])
    options = parser.parse_args()
    report = Report(options.quick, options.seed, options.workers)
    for study in (efficiency, heights, few_photons, posteriors):
        if options.only in (None, study.__name__):
            print(f"-- {study.__name__}", flush=True)
            study(report)
    RESULTS.mkdir(exist_ok=True)
    name = f"estimators_{options.only}" if options.only else "estimators"
    text = json.dumps({**report.numbers, "broken": report.broken}, indent=2)
    (RESULTS / f"{name}.json").write_text(text + "\n", encoding="utf-8")
    return 1 if report.broken and not options.quick else 0


if __name__ == "__main__":
    sys.exit(main())
