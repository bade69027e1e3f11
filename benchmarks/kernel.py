"""Where a pass of the fit spends its time, and what the processor could do.

    python benchmarks/kernel.py [--quick] [--against COMMIT]

One pass gives value, score and Fisher matrix of five parameters on n × n pixels.  Its parts are
timed one at a time on 32 × 32 pixels, beside a chain of scalar fused multiply-adds that keeps
every unit busy, and the time per pass of three sizes is split into a part per pass and one per
pixel.  The whole pass is compared with that of an earlier commit, and that of a pupil with
astigmatism and coma with that of a round one.

Other processes take up to half of a core's speed, for seconds at a time, and processor time counts
that as work.  So both versions stand ready and take turns of a few milliseconds, which find the
machine in the same state: a ratio is the median of 400 turns, a time the best single pass.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from fits import Batch
from numba import njit

from iscat_analysis._kernels import image, radial, radial_rows, scoring
from iscat_analysis._kernels.radial_rows import evaluate_slopes
from iscat_analysis.records import FloatArray

RESULTS = Path(__file__).resolve().parent / "results"
SIDES = (13, 32, 64)
SIDE = 32
CHAINS = 16
COMPARED_SIDE = 96
TURNS = 400
BEFORE = "399f8a7"
"""The last commit whose only pupil was round and linearly polarised."""


@njit(fastmath={"contract"}, error_model="numpy")  # type: ignore[untyped-decorator]
def multiply_add(repeats: int, a: float, b: float) -> float:
    """16 chains of scalar multiply-adds, none of which waits for another."""
    c0 = c1 = c2 = c3 = c4 = c5 = c6 = c7 = a
    d0 = d1 = d2 = d3 = d4 = d5 = d6 = d7 = b
    for _ in range(repeats):
        c0, c1, c2, c3 = c0 * a + b, c1 * a + b, c2 * a + b, c3 * a + b
        c4, c5, c6, c7 = c4 * a + b, c5 * a + b, c6 * a + b, c7 * a + b
        d0, d1, d2, d3 = d0 * b + a, d1 * b + a, d2 * b + a, d3 * b + a
        d4, d5, d6, d7 = d4 * b + a, d5 * b + a, d6 * b + a, d7 * b + a
    return c0 + c1 + c2 + c3 + c4 + c5 + c6 + c7 + d0 + d1 + d2 + d3 + d4 + d5 + d6 + d7


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def heights(repeats, axial, z, stop, profile):  # type: ignore[no-untyped-def]
    for k in range(repeats):
        radial.profile_at(axial, z + 1e-3 * k, 0, stop, profile)


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def strips(repeats, profile, f):  # type: ignore[no-untyped-def]
    for _ in range(repeats):
        evaluate_slopes(profile, f)


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def gradients(repeats, profile, lens, pixels, theta, g):  # type: ignore[no-untyped-def]
    for k in range(repeats):
        theta[0] += 0.1 * (k % 7 - 3)
        image.signal_gradient(profile, lens, pixels, theta, g)


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def scores(repeats, measured, g, score, fisher):  # type: ignore[no-untyped-def]
    for _ in range(repeats):
        scoring.image_score(measured, 1.0, g, (score, fisher))


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def passes(  # type: ignore[no-untyped-def]
    repeats, axial, theta, start, stop, profile, lens, pixels, measured, score, fisher
):
    for _ in range(repeats):
        radial.profile_at(axial, theta[2], start, stop, profile)
        scoring.score_pass(profile, lens, pixels, measured, theta, (score, fisher))


def seconds(run: Callable[..., object], repeats: int, *arguments: object) -> float:
    """Processor time of one repetition, the best of five turns."""
    run(2, *arguments)
    best = np.inf
    for _ in range(5):
        begun = time.process_time()
        run(repeats, *arguments)
        best = min(best, time.process_time() - begun)
    return float(best) / repeats


def pass_seconds(side: int, repeats: int) -> float:
    """Processor time of one whole pass, with the profile at a new height."""
    likelihood, theta, _ = Batch(side, 1).sets[0]
    axial, arguments = likelihood.model.axial_table, likelihood._arguments
    lens, pixels = arguments[:2]
    profile = scoring.blank_profile(axial, lens, 2)
    start, stop = scoring.span(lens, pixels, theta, axial.heights.shape[3])
    score, fisher = np.empty(5), np.empty((5, 5))
    return seconds(passes, repeats, axial, theta, start, stop, profile, *arguments, score, fisher)


COMPARED = """
import json, sys, time
import numpy as np
try:
    from iscat_analysis.optics.forward import PixelGrid, forward_model
    from iscat_analysis.inference.counts import asimov_conditional
except ImportError:
    from iscat_analysis.forward import PixelGrid, forward_model
    from iscat_analysis.likelihood import asimov_conditional
from iscat_analysis.config import parse_config
repeats, side, pixel = int(sys.argv[1]), int(sys.argv[2]), 84.4
def work(**optics):
    config = parse_config({
        "optics": {"wavelength_nm": 525.0, "na": 1.42, "emission": "reciprocal", **optics},
        "camera": {"pixel_size_nm": pixel},
        "particle": {"kind": "protein", "mass_kda": 1000.0, "height_nm": 5.0},
        "fit": {"z_range_nm": [0.0, 100.0]},
    })
    grid = PixelGrid.centred(side, pixel)
    model = forward_model(config, grid.diagonal_nm)
    theta = np.array([17.0, -29.0, 50.0, 1000.0, 0.0])
    likelihood = asimov_conditional(model, grid, theta, 1e4, 200, 200)
    return lambda: likelihood.score_fisher(theta)
jobs = {"round": work()}
if len(sys.argv) > 3:
    jobs["circular"] = work(polarization="circular", analyzer=True)
    jobs["general"] = work(aberrations_nm={"z5": 15.0, "z6": -10.0, "z7": 12.0, "z8": 20.0})
for job in jobs.values():
    job()
for _ in sys.stdin:
    best = dict.fromkeys(jobs, np.inf)
    for name, job in jobs.items():
        for _ in range(repeats):
            begun = time.process_time()
            job()
            best[name] = min(best[name], (time.process_time() - begun) / side**2)
    print(json.dumps(best), flush=True)
"""
"""Seconds per pixel and pass, through names that every version has; large enough a field that the
call itself does not count."""


def _worker(where: Path, repeats: int, *more: str) -> subprocess.Popen[str]:
    """Start a process that times the passes of the version in a folder whenever it is asked."""
    return subprocess.Popen(
        [sys.executable, "-c", COMPARED, str(repeats), str(COMPARED_SIDE), *more],
        env={**os.environ, "PYTHONPATH": str(where)},
        cwd=where, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip


def _turn(worker: subprocess.Popen[str]) -> dict[str, float]:
    """Ask for the best of a few passes of each kind [s per pixel]."""
    assert worker.stdin
    assert worker.stdout
    print(file=worker.stdin, flush=True)
    found: dict[str, float] = json.loads(worker.stdout.readline())
    return found


def versions(commit: str, repeats: int) -> dict[str, float]:
    """Compare this version's pass with an earlier commit's, and a general pupil's with a round."""
    folder = RESULTS / f"kernel-{commit}"
    folder.mkdir(parents=True, exist_ok=True)
    root = Path(__file__).resolve().parents[1]
    archive = subprocess.run(
        ["git", "archive", commit, "iscat_analysis"], cwd=root, check=True, capture_output=True
    )
    subprocess.run(["tar", "-x", "-C", str(folder)], input=archive.stdout, check=True)
    with _worker(folder, repeats) as before, _worker(root, repeats, "all") as after:
        turns = [(_turn(before), _turn(after)) for _ in range(TURNS)]
    both = [{"before": old["round"], **new} for old, new in turns]
    best = {key: min(turn[key] for turn in both) for key in both[0]}
    faster = [turn["before"] / turn["round"] for turn in both]
    dearer = [turn["general"] / turn["round"] for turn in both]
    return {
        **{f"{key}_ns_per_pixel": 1e9 * value for key, value in best.items()},
        "speed_of_round_over_before": statistics.median(faster),
        "time_of_general_over_round": statistics.median(dearer),
    }


def parts(repeats: int) -> dict[str, float]:
    """Nanoseconds of each part: of a pass, then of a pixel."""
    likelihood, start, _ = Batch(SIDE, 1).sets[0]
    axial = likelihood.model.axial_table
    lens, pixels, measured = likelihood._arguments
    profile = scoring.blank_profile(axial, lens, 2)
    _, stop = scoring.span(lens, pixels, start, axial.heights.shape[3])
    turn = seconds(heights, repeats, axial, start[2], stop, profile)
    f: FloatArray = np.zeros((20, radial_rows.padded(SIDE**2)))
    f[radial_rows.DISTANCE] = np.linspace(0, stop // radial.POWERS - 1, f.shape[1])
    g = np.zeros((SIDE, 5, SIDE))
    whole = seconds(gradients, repeats, profile, lens, pixels, start, g)
    horner = seconds(strips, repeats, profile, f) * pixels.offsets.size**2
    g[:] = 1e-3
    found = {
        "quintics": horner,
        "fields": whole - horner,
        "value_and_score": seconds(scores, repeats, measured, g, np.zeros(5), np.zeros((5, 5))),
    }
    per = 1e9 / SIDE**2
    parts = {f"{name}_ns_per_pixel": per * took for name, took in found.items()}
    return {"heights_ns_per_pass": 1e9 * turn} | parts


def main() -> None:
    parser = argparse.ArgumentParser(description="The parts of a pass of the fit.")
    parser.add_argument("--quick", action="store_true", help="fewer repetitions")
    parser.add_argument("--against", default=BEFORE, help="commit to compare with")
    given = parser.parse_args()
    repeats = 2_000 if given.quick else 20_000
    RESULTS.mkdir(exist_ok=True)
    found = parts(repeats)
    whole = {side: pass_seconds(side, repeats // 10) for side in SIDES}
    pixels = np.array([side**2 for side in SIDES])
    per_pixel, per_pass = np.polyfit(pixels, [1e9 * whole[side] for side in SIDES], 1)
    found |= {f"pass_us_{side}": 1e6 * t for side, t in whole.items()}
    found |= {"ns_per_pixel": float(per_pixel), "ns_per_pass": float(per_pass)}
    found["multiply_add_ns"] = 1e9 * seconds(multiply_add, 50 * repeats, 0.5, 0.25) / CHAINS
    found |= versions(given.against, repeats // 2000)
    for key, value in found.items():
        print(f"{key:42} {value:.4g}")
    (RESULTS / "kernel.json").write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
