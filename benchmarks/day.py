"""A simulated day of 24 movies: K_D in one command, a movie more, a movie that is corrupt.

    python benchmarks/day.py [--quick] [--keep FOLDER]

One calibrant (66, 146, 480 kDa), one blank, six concentrations of a protein of 66 kDa that
dimerises with K_D = 10 nM, three movies of each, and four controls that do not.  What the analysis
does not know: the focus differs by a few nanometres from movie to movie, the laser's power by a
tenth, the monomers' mass from the standards'.  `iscat batch` is called as a user calls it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pandas as pd

ROOT = Path(__file__).resolve().parent
RESULTS = ROOT / "results"
CONFIG = ROOT.parent / "sample_configs" / "landing.toml"
KD_NM, MONOMER_KDA = 10.0, 66.0
CONCENTRATIONS = (1.0, 3.0, 6.0, 12.0, 30.0, 100.0)
STANDARDS = (66.0, 146.0, 480.0)


def main() -> int:
    parser = argparse.ArgumentParser(description="Analyse a simulated day.")
    parser.add_argument("--quick", action="store_true", help="a third of the particles and frames")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep movies and results here")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        passed = measure(folder, particles=30 if options.quick else 90)
    return 0 if passed else 1


def measure(folder: Path, particles: int) -> bool:
    """Simulate and analyse the day, then change it."""
    frames = 500 + 18 * particles
    rows = day(particles)
    simulate(folder, rows, frames)
    analysed, took = batch(folder, rows)
    found = pd.read_csv(folder / "day" / "kd.csv").iloc[0]
    again, _ = batch(folder, rows)

    further = {**rows[2], "path": "further.tif", "replicate": "4", "seed": 99}
    simulate(folder, [further], frames)
    after, _ = batch(folder, [*rows, further])

    corrupt = folder / rows[-1]["path"]
    corrupt.write_bytes(corrupt.read_bytes()[: corrupt.stat().st_size // 3])
    (folder / "samples.csv").touch()
    broken, _ = batch(folder, [*rows, further], status=3)
    states = pd.read_csv(folder / "day" / "movies.csv")["state"].value_counts()

    numbers = {
        "movies": len(rows),
        "seconds": took,
        "kd_nm": found["kd_nm"],
        "kd_low": found["kd_low"],
        "kd_high": found["kd_high"],
        "p_value": found["p_value"],
        "analysed": [analysed, again, after, broken],
        "done_with_a_corrupt_movie": int(states["done"]),
    }
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "day.json").write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(numbers, indent=1))
    return bool(
        found["kd_low"] < KD_NM < found["kd_high"]
        and numbers["analysed"] == [len(rows), 0, 1, 0]
        and states.to_dict() == {"done": len(rows), "failed": 1}
    )


def day(particles: int) -> list[dict]:
    """Lay out the table, with what only the simulation knows."""
    random = np.random.default_rng(7)
    rows: list[dict] = [
        {"path": "standards.tif", "sample": "standards", "role": "calibrant",
         "standards": " ".join(f"{m:g}" for m in STANDARDS),
         "masses": np.resize(STANDARDS, particles)},
        {"path": "buffer.tif", "sample": "buffer", "role": "blank", "masses": []},
    ]  # fmt: skip
    for concentration in CONCENTRATIONS:
        free = 2 * concentration / (1 + np.sqrt(1 + 8 * concentration / KD_NM))
        landing = free**2 / KD_NM * 2 ** (-1 / 6)  # of dimers, which diffuse more slowly
        for replicate in (1, 2, 3):
            dimers = random.binomial(particles, landing / (landing + free))
            masses = np.repeat([1.0, 2.0], [particles - dimers, dimers]) * MONOMER_KDA
            rows.append(
                {"path": f"c{concentration:g}-{replicate}.tif", "sample": f"{concentration:g} nM",
                 "condition": "wild type", "concentration_nm": concentration, "role": "sample",
                 "replicate": replicate, "masses": masses}
            )  # fmt: skip
    rows += [
        {"path": f"mutant-{replicate}.tif", "sample": "mutant", "condition": "mutant",
         "concentration_nm": 30.0, "role": "sample", "replicate": replicate,
         "masses": np.full(particles, MONOMER_KDA)}
        for replicate in (1, 2, 3, 4)
    ]  # fmt: skip
    return [{**row, "seed": seed} for seed, row in enumerate(rows, 1)]


def simulate(folder: Path, rows: list[dict], frames: int) -> None:
    """Write the movies that are not there yet."""

    def write(row: dict) -> None:
        random = np.random.default_rng(row["seed"])
        masses = [float(mass) for mass in random.permutation(row["masses"])]
        settings = {
            "simulation.seed": row["seed"],
            "simulation.count": len(masses),
            "simulation.leavings": 0,
            "simulation.frames": frames,
            "simulation.photons_per_pixel": 1e5 * random.uniform(0.95, 1.05),
            "optics.focus_nm": -300 + random.normal(0, 3),
            **({"simulation.species": masses} if masses else {}),
        }
        changes = [word for item in settings.items() for word in ("--set", "{}={}".format(*item))]
        call("simulate", "--config", CONFIG, "--out", folder / row["path"], *changes)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(write, [row for row in rows if not (folder / row["path"]).exists()]))


def batch(folder: Path, rows: list[dict], status: int = 0) -> tuple[int, float]:
    """Analyse the table; how many movies were analysed now, and in which time [s]."""
    table = pd.DataFrame(rows).drop(columns=["masses", "seed"])
    table.to_csv(folder / "samples.csv", index=False)
    results = list((folder / "day").glob("movies/*.iscat/summary.json"))
    before = {path: path.stat().st_mtime_ns for path in results}
    start = time.perf_counter()
    call(
        "batch", folder / "samples.csv", "--config", CONFIG, "--out", folder / "day",
        "--kd", "dimer", "--kd-masses", f"{MONOMER_KDA:g}", status=status,
    )  # fmt: skip
    took = time.perf_counter() - start
    results = (folder / "day").glob("movies/*.iscat/summary.json")
    now = {path: path.stat().st_mtime_ns for path in results}
    return sum(before.get(path) != when for path, when in now.items()), took


def call(*words: object, status: int = 0) -> None:
    """Run iscat, and see that it ends as it should."""
    command = [Path(sys.executable).parent / "iscat", *words]
    done = subprocess.run([str(word) for word in command], stdout=sys.stderr, check=False)
    if done.returncode != status:
        raise SystemExit(f"{' '.join(map(str, words))}: exit status {done.returncode}")


if __name__ == "__main__":
    sys.exit(main())
