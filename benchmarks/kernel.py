"""Where a pass of the fit spends its time, and what the processor could do.

    python benchmarks/kernel.py [--quick]

One pass gives value, score and Fisher matrix of five parameters on n × n pixels.  Its parts are
timed one at a time on rows of 32 pixels, beside a chain of scalar fused multiply-adds that keeps
every unit busy, and the time per pass of three sizes is split into a part per pass and one per
pixel.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from fits import Batch
from numba import njit

from iscat_analysis._kernels import image, radial, scoring
from iscat_analysis.records import FloatArray

RESULTS = Path(__file__).resolve().parent / "results"
SIDES = (13, 32, 64)
SIDE = 32
CHAINS = 16


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
def heights(repeats, axial, z, intervals, work, profile):  # type: ignore[no-untyped-def]
    for k in range(repeats):
        radial.profile_at(axial, z + 1e-3 * k, intervals, work, profile)


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def quintics(repeats, profile, lens, x, f):  # type: ignore[no-untyped-def]
    for k in range(repeats):
        image._row_fields(profile, lens.inv_step, x, 0.1 * (k % 7), 100.0, True, f)


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def gradients(repeats, profile, lens, x, f, g):  # type: ignore[no-untyped-def]
    for k in range(repeats):
        image._row_gradient(profile, lens, x, 0.1 * (k % 7), 100.0, 1e-3, 1e-9, f, g)


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def values(repeats, kind, data, g):  # type: ignore[no-untyped-def]
    total = 0.0
    for k in range(repeats):
        total += scoring._row_value(kind, data, k % data.shape[1], 1.0, g[0])
    return total


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def scores(repeats, kind, data, g, sums):  # type: ignore[no-untyped-def]
    for k in range(repeats):
        scoring._row_score(kind, data, k % data.shape[1], 1.0, g, sums)


@njit(error_model="numpy")  # type: ignore[untyped-decorator]
def passes(  # type: ignore[no-untyped-def]
    repeats, axial, theta, reach, work, profile, lens, pixels, kind, data, score, fisher
):
    for _ in range(repeats):
        radial.profile_at(axial, theta[2], reach, work, profile)
        scoring.score_pass(profile, lens, pixels, kind, data, theta, score, fisher)


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
    """Processor time of one whole pass."""
    likelihood, start, _ = Batch(side, 1).sets[0]
    arguments = likelihood._arguments
    axial, lens, pixels, kind, data = arguments
    work = np.empty((4, 2, axial.heights.shape[3]))
    profile = np.empty((8, axial.heights.shape[3] // 6, 6))
    reach = scoring._intervals(pixels, start, lens.inv_step)
    score, fisher = np.empty(5), np.empty((5, 5))

    return seconds(
        passes, repeats, axial, start, reach, work, profile, lens, pixels, kind, data, score, fisher
    )


def parts(repeats: int) -> dict[str, float]:
    """Nanoseconds of each part: of a pass, then of a pixel."""
    likelihood, start, _ = Batch(SIDE, 1).sets[0]
    axial, lens, pixels, kind, data = likelihood._arguments
    work = np.empty((4, 2, axial.heights.shape[3]))
    profile = np.empty((8, axial.heights.shape[3] // 6, 6))
    reach = scoring._intervals(pixels, start, lens.inv_step)
    x = pixels.x - pixels.x.mean()
    f: FloatArray = np.zeros((image.SCRATCH, x.size))
    g, sums = np.zeros((5, x.size)), np.zeros(20)
    whole = seconds(gradients, repeats, profile, lens, x, f, g)
    radii = seconds(quintics, repeats, profile, lens, x, f)
    samples = pixels.offsets.size**2
    g[:] = 1e-3
    value, score = (
        seconds(values, repeats, kind, data, g),
        seconds(scores, repeats, kind, data, g, sums),
    )
    per = 1e9 / x.size
    return {
        "heights_ns_per_pass": 1e9
        * seconds(heights, repeats, axial, start[2], reach, work, profile),
        "quintics_ns_per_pixel": radii * samples * per,
        "fields_ns_per_pixel": (whole - radii) * samples * per,
        "value_ns_per_pixel": value * per,
        "score_and_fisher_ns_per_pixel": score * per,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="The parts of a pass of the fit.")
    parser.add_argument("--quick", action="store_true", help="fewer repetitions")
    repeats = 2_000 if parser.parse_args().quick else 20_000
    RESULTS.mkdir(exist_ok=True)
    found = parts(repeats)
    whole = {side: pass_seconds(side, repeats // 10) for side in SIDES}
    pixels = np.array([side**2 for side in SIDES])
    per_pixel, per_pass = np.polyfit(pixels, [1e9 * whole[side] for side in SIDES], 1)
    found |= {f"pass_us_{side}": 1e6 * t for side, t in whole.items()}
    found |= {"ns_per_pixel": float(per_pixel), "ns_per_pass": float(per_pass)}
    found["multiply_add_ns"] = 1e9 * seconds(multiply_add, 50 * repeats, 0.5, 0.25) / CHAINS
    for key, value in found.items():
        print(f"{key:42} {value:.4g}")
    (RESULTS / "kernel.json").write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
