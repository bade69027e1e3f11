"""Speed of the fits at the bound, in one run with Picasso's Gaussian maximum likelihood.

    python benchmarks/fits.py [--peer PYTHON] [--skip-peer] [--quick]

Five parameters (x, y, z, mass, level) on 13 × 13, 32 × 32 and 64 × 64 pixels, in double precision;
spread over CRB comes from the fits that were timed.  The peer fits six parameters of a Gaussian in
single precision, in an environment of its own under ``benchmarks/results``, made on the first run;
``--peer`` names a Python that has it.  Peer and model run in turns; rates are per second of
processor time, each the best of its turns, so that a busy machine flatters nobody.  Only the
scaling with threads is on the wall clock, and wants an idle machine.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402  # after the thread counts
from _peer import peer_python  # noqa: E402

from iscat_analysis.config import parse_config  # noqa: E402
from iscat_analysis.inference.fit import compile_kernels, fit_particle, search_box, start_theta  # noqa: E402
from iscat_analysis.inference.likelihood import Likelihood  # noqa: E402
from iscat_analysis.records import Box, Candidate, FloatArray  # noqa: E402
from iscat_analysis.study import Setting, make_setting, trial_generator  # noqa: E402

ROOT = Path(__file__).resolve().parent
RESULTS = ROOT / "results"
PEER_PACKAGE = "picassosr==0.11.3"
SIDES = (13, 32, 64)
PIXEL_NM = 84.4
PHOTONS = 5000.0
WALKERS = 32

PEER = """
import json, sys, time, warnings
warnings.simplefilter("ignore")
import numpy as np
from picasso import gaussmle
from picasso.fitting import gaussfit, seeds
count = int(sys.argv[1])
out = {}
for side, sigma in ((13, 1.3), (32, 4.0)):
    rng = np.random.default_rng(1)
    axis = np.arange(side)
    spots = np.empty((count, side, side), np.float32)
    for i in range(count):
        x, y = (side - 1) / 2 + rng.uniform(-0.5, 0.5, 2)
        bell = np.exp(-((axis - x) ** 2 + (axis[:, None] - y) ** 2) / (2 * sigma**2))
        spots[i] = rng.poisson(10 + 5000 * bell / (2 * np.pi * sigma**2))
    fit = gaussmle._gaussmle
    fit(spots[:2], 0.001, 100, "sigmaxy")
    begun = time.process_time()
    thetas, bounds, _, iterations = fit(spots, 0.001, 100, "sigmaxy")
    out[f"newton_{side}"] = count / (time.process_time() - begun)
    out[f"newton_{side}_iterations"] = float(np.mean(iterations))
    begin = seeds.initial_parameters_gauss(spots, side)
    gaussfit.fit_spots(gaussfit.ELLIPTIC, spots[:2], begin[:2], mle=True)
    begun = time.process_time()
    begin = seeds.initial_parameters_gauss(spots, side)
    gaussfit.fit_spots(gaussfit.ELLIPTIC, spots, begin, mle=True)
    out[f"levenberg_{side}"] = count / (time.process_time() - begun)
json.dump(out, sys.stdout)
"""


def run_peer(python: Path, count: int) -> dict[str, float]:
    done = subprocess.run(
        [str(python), "-c", PEER, str(count)], check=True, capture_output=True, text=True
    )
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def experiment(side: int, mode: str = "joint") -> Setting:
    """One protein of 1 MDa, 5000 scattered photons, on side × side pixels.

    Its height is 100 nm where it is fitted, else that of the configuration.
    """
    return make_setting(
        parse_config(
            {
                "optics": {"wavelength_nm": 525.0, "na": 1.42, "focus_nm": -500.0},
                "camera": {"pixel_size_nm": PIXEL_NM},
                "particle": {"kind": "protein", "mass_kda": 1000.0, "height_nm": 5.0},
                "fit": {"roi_nm": side * PIXEL_NM, "z_range_nm": [0.0, 500.0]},
                "calibration": {"gradient_per_kda": -3.1e-5},
                "bounds": {"n_before": 200, "n_after": 200, "x_nm": 17.0, "y_nm": -29.0},
            }
        ),
        mode,
        collected=PHOTONS,
        z_nm=100.0 if mode == "joint" else None,
    )


class Batch:
    """Data sets with their starts, to be fitted again and again."""

    def __init__(self, side: int, count: int) -> None:
        self.setting = experiment(side)
        compile_kernels(self.setting.context.model, heights="z_nm" in self.setting.free)
        pixel, truth = self.setting.context.pixel_nm, self.setting.truth
        self.sets: list[tuple[Likelihood, FloatArray, Box]] = []
        for i in range(count):
            random = trial_generator(5, side, i)
            likelihood = self.setting.likelihood(self.setting.draw(truth, random))
            x, y = truth[:2] / pixel + random.uniform(-0.5, 0.5, 2)
            start = Candidate(x, y, truth[2] + random.uniform(-20, 20), truth[3] * 1.2, 0.0)
            theta = start_theta(likelihood, start)
            box = search_box(likelihood, theta, "joint", (0.0, 500.0), level=True)
            self.sets.append((likelihood, theta, box))
        fixed = experiment(side, "mass")
        some = range(min(max(count // 10, 10), count))
        self.whole = {
            "joint": (self.setting, 50.0, [self.sets[i][0] for i in some]),
            "mass": (fixed, float(fixed.truth[2]), [
                fixed.likelihood(fixed.draw(fixed.truth, trial_generator(6, side, i))) for i in some
            ]),
        }  # fmt: skip
        self.estimates = np.empty((count, 5))
        self.passes = np.empty(count)
        self.converged = np.empty(count, dtype=bool)

    def fit(self, numbers: range) -> None:
        """Fit some of the data sets."""
        for i in numbers:
            likelihood, start, box = self.sets[i]
            found = likelihood.maximize(start, box)
            self.estimates[i] = found.theta
            self.passes[i] = found.passes
            self.converged[i] = found.converged

    def per_second(self, threads: int, *, processor: bool) -> float:
        """Fit them all on a number of threads."""
        count = len(self.sets)
        shares = [range(k, count, threads) for k in range(threads)]
        with ThreadPoolExecutor(threads) as pool:
            clock = time.process_time if processor else time.perf_counter
            begun = clock()
            list(pool.map(self.fit, shares))
            return count / (clock() - begun)

    def spread_over_crb(self) -> list[float]:
        """Spread of the last estimates over the joint bound of all five parameters."""
        bound = self.setting.experiment
        fisher = bound.likelihood.score_fisher(bound.theta)[2]
        crb = np.sqrt(np.diag(np.linalg.inv(fisher)))
        return [float(r) for r in np.std(self.estimates, axis=0, ddof=1) / crb]

    def whole_fits_per_second(self, mode: str) -> float:
        """Fits with the search of heights, uncertainty and goodness of fit, as a movie's are."""
        setting, z_nm, some = self.whole[mode]
        pixel, truth = setting.context.pixel_nm, setting.truth
        start = Candidate(truth[0] / pixel + 0.3, truth[1] / pixel - 0.3, z_nm, 800.0, 0.0)
        fit_particle(some[0], start, mode, (0.0, 500.0), level=False)
        begun = time.process_time()
        for likelihood in some:
            fit_particle(likelihood, start, mode, (0.0, 500.0), level=False)
        return len(some) / (time.process_time() - begun)

    def evaluations_per_second(self, repeats: int) -> float:
        """Log-likelihoods of an ensemble's proposals, every parameter new in each."""
        likelihood, start, _ = self.sets[0]
        rng = np.random.default_rng(3)
        thetas = start + rng.normal(size=(WALKERS, 5)) * [3, 3, 1, start[3] * 0.02, 1e-5]
        likelihood.values(thetas)
        begun = time.process_time()
        for _ in range(repeats):
            likelihood.values(thetas)
        return repeats * WALKERS / (time.process_time() - begun)


def measure(batches: dict[int, Batch], repeats: int) -> dict[str, float]:
    """One turn: figures of which the largest counts."""
    found = {}
    for side, batch in batches.items():
        found[f"fits_per_s_{side}"] = batch.per_second(1, processor=True)
        found[f"wall_fits_per_s_{side}_1_thread"] = batch.per_second(1, processor=False)
        found[f"wall_fits_per_s_{side}_2_threads"] = batch.per_second(2, processor=False)
        for mode in batch.whole:
            found[f"whole_fits_per_s_{mode}_{side}"] = batch.whole_fits_per_second(mode)
        found[f"log_likelihoods_per_s_{side}"] = batch.evaluations_per_second(repeats)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description="Speed of the fits.")
    parser.add_argument("--peer", type=Path, help="a Python that has picassosr")
    parser.add_argument("--skip-peer", action="store_true")
    parser.add_argument("--quick", action="store_true", help="fewer fits and turns")
    options = parser.parse_args()
    count, turns = (400, 2) if options.quick else (4000, 5)
    RESULTS.mkdir(exist_ok=True)
    batches = {side: Batch(side, count) for side in SIDES}
    found = measure(batches, 50)  # compiles what is not yet compiled
    python = None
    if not options.skip_peer:
        try:
            python = options.peer or peer_python("picasso", PEER_PACKAGE)
        except (OSError, subprocess.CalledProcessError) as error:
            print(f"{PEER_PACKAGE} cannot be installed here: {error}", file=sys.stderr)
    peer: dict[str, float] = {}
    for _ in range(turns):
        again = measure(batches, 200)
        found = {key: max(found[key], value) for key, value in again.items()}
        if python is not None:
            once = run_peer(python, 100 if options.quick else 300)
            peer = {key: max(peer.get(key, 0.0), value) for key, value in once.items()}
    for side, batch in batches.items():
        found[f"scaling_2_threads_{side}"] = (
            found[f"wall_fits_per_s_{side}_2_threads"] / found[f"wall_fits_per_s_{side}_1_thread"]
        )
        found[f"passes_{side}"] = float(batch.passes.mean())
        found[f"ns_per_pixel_and_pass_{side}"] = 1e9 / (
            found[f"fits_per_s_{side}"] * side**2 * found[f"passes_{side}"]
        )
        found[f"not_converged_{side}"] = int(np.sum(~batch.converged))
        names = ("x", "y", "z", "mass", "level")
        for parameter, ratio in zip(names, batch.spread_over_crb(), strict=True):
            found[f"spread_over_crb_{side}_{parameter}"] = ratio
    for key, value in peer.items():
        found[f"picasso_{key}"] = value
    for kind in ("newton", "levenberg") if peer else ():
        for side in (13, 32):
            rate = found[f"fits_per_s_{side}"] / peer[f"{kind}_{side}"]
            found[f"ratio_to_picasso_{kind}_{side}"] = rate
    for key, value in found.items():
        print(f"{key:42} {value:.4g}")
    (RESULTS / "fits.json").write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
