"""Landing movies: what is found of what is there, on enough movies to hold the promises.

    python benchmarks/recovery.py [--quick] [--movies 10] [--blanks 20] [--seed N]

Movies of 256 × 256 × 4 000 frames with 300 landings and 60 leavings of 66, 146 and 480 kDa.  A step
counts as found where the table has one of its sign within 3 pixels and a quarter window; it is
isolated where no other step lies within two windows and 1.5 µm.  Blank movies are searched at one
false alarm expected in each.  Statistics are over the rows whose status is ``ok``;
spread over CRB is of all species together, because of one alone it is known to 3 % only.
Exit status 1 where a promise is broken; ``--quick`` takes one small movie of each kind and judges
nothing.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import poisson

from iscat_analysis.camera import camera_from_config
from iscat_analysis.config import Config, load_config
from iscat_analysis.fitting.results import DetectionResult
from iscat_analysis.fitting.run import Run
from iscat_analysis.landing.find import analyse_landings
from iscat_analysis.records import FRAME_COLUMN
from iscat_analysis.study import Movie

ROOT = Path(__file__).resolve().parent
RESULTS = ROOT / "results"
CONFIG = ROOT.parent / "sample_configs" / "landing.toml"
FULL = [
    "simulation.shape=[256, 256]",
    "simulation.frames=4000",
    "simulation.count=300",
    "simulation.leavings=60",
]
NEAR_PX, ISOLATED_NM = 3.0, 1500.0
RECALL = {66.0: 0.90, 146.0: 0.98, 480.0: 0.98}
BIAS, BIAS_SE, PULL, SPREAD, FRAMES, TAIL = 0.01, 3.0, 0.1, 1.05, 0.95, 1e-3


class Memory:
    """A movie in memory."""

    def __init__(self, counts: np.ndarray) -> None:
        self.counts, self.shape, self.dtype = counts, counts.shape, counts.dtype
        self.name = "movie"

    def read(self, start: int, stop: int) -> np.ndarray:
        """Frames [start, stop)."""
        return self.counts[start:stop]


def analyse(config: Config, seed: int) -> tuple[pd.DataFrame, DetectionResult]:
    """Simulate a movie and analyse it; its steps, and what was found."""
    movie = Movie(config, seed)
    simulation = config.simulation
    counts = np.empty((simulation.frames, *simulation.shape), dtype=np.uint16)
    for frame, image in enumerate(movie.frames(config.compute.workers)):
        counts[frame] = image
    found = analyse_landings(
        Memory(counts), config, camera_from_config(config.camera, simulation.shape, np.uint16),
        Run(notify=lambda text: print(f"   {text}", flush=True)),
    )  # fmt: skip
    truth = movie.truth
    landing = truth.assign(sign=1)
    leaving = truth[truth["leave"].notna()].assign(sign=-1)
    leaving["frame"] = leaving["leave"].astype(int)
    return pd.concat([landing, leaving], ignore_index=True), found


def match(steps: pd.DataFrame, result: DetectionResult, pixel_nm: float) -> pd.DataFrame:
    """Add to every step what was found of it; the nearest in space, each row once."""
    window, table = result.summary["window_frames"], result.fits
    taken: set[int] = set()
    rows = []
    for step in steps.itertuples():
        frames = (table["frame"] - step.frame).abs()
        away = np.hypot(table["x_px"] - step.x_px, table["y_px"] - step.y_px)
        fits = (frames <= window // 4) & (away < NEAR_PX) & (table["mass_kda"] * step.sign > 0)
        free = [i for i in away[fits].sort_values().index if i not in taken]
        rows.append(table.loc[free[0]] if free else pd.Series(dtype=float))
        taken.update(free[:1])
    gap = np.abs(steps["frame"].to_numpy()[:, None] - steps["frame"].to_numpy())
    x, y = steps["x_px"].to_numpy(), steps["y_px"].to_numpy()
    apart = np.hypot(x[:, None] - x, y[:, None] - y)
    crowd = (gap < 2 * window) & (apart < ISOLATED_NM / pixel_nm)
    found = pd.DataFrame(rows, index=steps.index).add_prefix("found_")
    matched = steps.join(found)
    matched["found"] = matched["found_event"].notna()
    matched["isolated"] = crowd.sum(axis=1) == 1
    matched["false"] = len(table) - len(taken)
    return matched


class Promises:
    """Which hold."""

    def __init__(self) -> None:
        self.broken: list[str] = []

    def hold(self, kept: bool, text: str) -> None:
        """Book one promise."""
        print(("ok      " if kept else "BROKEN  ") + text, flush=True)
        if not kept:
            self.broken.append(text)


def judge(steps: pd.DataFrame, promises: Promises) -> dict[str, Any]:
    """Compare with the promises, species by species."""
    numbers: dict[str, Any] = {}
    for mass, group in steps.groupby("mass_kda"):
        isolated = group[group["isolated"]]
        recall = float(isolated["found"].mean())
        good = group[group["found_status"] == "ok"]
        error = good["found_mass_kda"].abs() - mass
        mean, se = float(error.mean()), float(error.std() / math.sqrt(len(error)))
        pull = float((error / good["found_sigma_mass_kda"]).std())
        late = (good["found_frame"] - good["frame"]).abs()
        inside = float((late <= good[f"found_{FRAME_COLUMN}"]).mean())
        within = float((late <= 1).mean())
        slack = 3 * math.sqrt(0.05 * 0.95 / len(good))
        spread = spreads(good[good["isolated"]])
        label = f"{mass:g} kDa: "
        promises.hold(
            recall >= RECALL[mass], f"{label}{recall:.1%} of {len(isolated)} isolated steps found"
        )
        promises.hold(
            abs(mean) < BIAS * mass and abs(mean) < BIAS_SE * se,
            f"{label}mean mass off by {mean / mass:+.2%} ± {se / mass:.2%} ({len(good)} steps)",
        )
        promises.hold(abs(pull - 1) <= PULL, f"{label}pulls of mass spread by {pull:.3f}")
        if mass > 100:
            promises.hold(within >= FRAMES, f"{label}frame within ±1 for {within:.1%}")
        promises.hold(
            inside >= FRAMES - slack, f"{label}frame inside its 95 % interval for {inside:.1%}"
        )
        numbers[f"{mass:g}"] = {
            "steps": len(group), "isolated": len(isolated), "recall_isolated": recall,
            "recall": float(group["found"].mean()), "ok": len(good), "mean_error_kda": mean,
            "mean_error_se_kda": se, "pull_std": pull, "spread_over_crb": spread,
            "frame_within_one": within, "frame_inside_interval": inside,
        }  # fmt: skip
    alone = steps[steps["isolated"] & (steps["found_status"] == "ok")]
    for name, ratio in spreads(alone).items():
        promises.hold(ratio <= SPREAD, f"spread/CRB of {name} {ratio:.3f} ({len(alone)} isolated)")
    return numbers


def spreads(steps: pd.DataFrame) -> dict[str, float]:
    """Spread over CRB of every parameter; the standard error is 1/√(2n)."""
    errors = {
        "mass_kda": steps["found_mass_kda"].abs() - steps["mass_kda"],
        "x_nm": steps["found_x_nm"] - steps["x_nm"],
        "y_nm": steps["found_y_nm"] - steps["y_nm"],
    }
    return {name: float(np.std(e / steps[f"found_crb_{name}"])) for name, e in errors.items()}


def main() -> int:
    parser = argparse.ArgumentParser(description="Landing movies: recall, bias, spread, alarms.")
    parser.add_argument("--quick", action="store_true", help="small movies, no judgement")
    parser.add_argument("--movies", type=int, default=10)
    parser.add_argument("--blanks", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    size = [] if options.quick else FULL
    movies, blanks = (1, 1) if options.quick else (options.movies, options.blanks)
    workers = f"compute.workers={os.cpu_count() or 1}"
    promises = Promises()
    config = load_config(CONFIG, [*size, workers])
    tables = []
    for seed in range(options.seed, options.seed + movies):
        steps, found = analyse(config, seed)
        table = match(steps, found, config.camera.pixel_size_nm or math.nan).assign(movie=seed)
        missed = int((~table["found"]).sum())
        print(f"movie {seed}: {len(table)} steps, {missed} missed, {table['false'][0]} false")
        tables.append(table)
    steps = pd.concat(tables, ignore_index=True)
    numbers: dict[str, Any] = {"movies": movies, "species": judge(steps, promises)}
    numbers["false_in_movies"] = int(steps.groupby("movie")["false"].first().sum())
    nothing = config.simulation.model_copy(update={"count": None, "leavings": 0, "events": ()})
    one = config.detection.model_copy(update={"false_alarms_per_movie": 1.0})
    blank = config.model_copy(update={"simulation": nothing, "detection": one})
    alarms = []
    for seed in range(options.seed, options.seed + blanks):
        alarms.append(len(analyse(blank, 1000 + seed)[1].fits))
        print(f"blank {seed}: {alarms[-1]}", flush=True)
    low, high = poisson.ppf(TAIL / 2, blanks), poisson.isf(TAIL / 2, blanks)
    promises.hold(
        low <= sum(alarms) <= high,
        f"{sum(alarms)} false alarms in {blanks} blank movies at 1 expected in each",
    )
    numbers["alarms_in_blanks"] = alarms
    RESULTS.mkdir(exist_ok=True)
    steps.to_csv(RESULTS / "recovery.csv", index=False)
    (RESULTS / "recovery.json").write_text(json.dumps(numbers, indent=2) + "\n", encoding="utf-8")
    return 1 if promises.broken and not options.quick else 0


if __name__ == "__main__":
    sys.exit(main())
