"""Everybody's estimators on the ready challenges: the numbers of ``benchmarks/challenge_*.csv``.

    python benchmarks/challenge.py                  # all presets, ten minutes
    python benchmarks/challenge.py easy hard
    python benchmarks/challenge.py map              # ten minutes; who is best where

Every estimator that is installed is run on the counts of every particle, given a start within a
pixel.  Movies are analysed by `iscat-fit` as well, which has to find the particles, and under an
unknown microscope to learn it; stacks by the Octave script beside this file, where there is one.

``map`` is `iscat benchmark` of ``sample_configs/mass.toml`` with all of them, in its three modes
(``benchmark_mass.csv``) and by height and collected photons (``benchmark_map.csv``).
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from iscat_analysis.report.benchmark import contest_parts
from iscat_contest.challenge import ABOUT
from iscat_contest.estimators import known_estimators

ROOT = Path(__file__).resolve().parent
RESULTS = ROOT / "results" / "challenge"
COLUMNS = (
    "answered", "failed", "bias", "spread", "rmse", "crb", "qcrb", "holevo", "efficiency_crb",
    "spread_over_crb", "spread_over_qcrb", "bias_gradient", "spread_over_biased_bound", "pull_std",
    "coverage68", "coverage95", "verdict",
)  # fmt: skip


def run(*command: object) -> None:
    print("$", *command, file=sys.stderr, flush=True)
    subprocess.run([str(part) for part in command], check=True, stdout=subprocess.DEVNULL)


def results_of(folder: Path) -> list[Path]:
    """Analyse the files of a challenge without its truth."""
    found = []
    for movie in sorted(folder.glob("movies/*.tif")):
        out = RESULTS / f"{folder.name}-iscat-fit" / f"{movie.stem}.iscat"
        out.parent.mkdir(exist_ok=True)
        config = folder / "config" / f"{movie.stem}.toml"
        run("iscat-fit", movie, "--config", config, "--out", out, "--overwrite", "--no-posterior")
        found.append(out)
    if shutil.which("octave-cli") and (folder / "stacks").is_dir() and folder.name == "easy":
        told = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))["parts"]["easy"]
        table = RESULTS / "octave.csv"
        before, pixel = told["n_before"], told["pixel_size_nm"]
        run("octave-cli", ROOT / "challenge.m", folder, before, pixel, table)
        found.append(table)
    return found


def map_of(found: Mapping[str, Any]) -> pd.DataFrame:
    """Tabulate who keeps most of the information at each height and light."""
    return pd.DataFrame([
        {"parameter": name, "height_nm": height, "photons": photons, "best": table["best"][r][c],
         "kept": table["kept"][r][c], "as_good": " ".join(table["equal"][r][c] or ())}
        for name, table in found["parameters"].items()
        for r, height in enumerate(found["height_nm"])
        for c, photons in enumerate(found["photons"])
    ])  # fmt: skip


def benchmark_all(chosen: list[str], trials: int) -> None:
    """Run a benchmark of one configuration with all estimators."""
    out, config = RESULTS / "map", ROOT.parent / "sample_configs" / "mass.toml"
    estimators = [part for name in chosen for part in ("--estimator", name)]
    run("iscat", "benchmark", "--config", config, "--set", "bounds.pixels=33", "--trials", trials,
        "--no-posterior", "--out", out, "--overwrite", *estimators)  # fmt: skip
    write_benchmark(out / "benchmark.json")


def write_benchmark(path: Path) -> None:
    """Write the two tables of a benchmark."""
    study = json.loads(path.read_text(encoding="utf-8"))
    table = table_of(contest_parts(study))
    table.to_csv(ROOT / "benchmark_mass.csv", index=False, float_format="%.4g")
    found = map_of(study["estimator_map"])
    found.to_csv(ROOT / "benchmark_map.csv", index=False, float_format="%.4g")


def table_of(parts: Mapping[str, Any]) -> pd.DataFrame:
    """Tabulate what was scored, without the resamples' intervals of everything."""
    rows = []
    for part, entries in parts.items():
        for who, entry in entries["estimators"].items():
            for name in ("x_nm", "y_nm", "z_nm", "mass_kda"):
                scored = entry.get(name)
                if scored is not None:
                    low, high = scored.get("efficiency_crb_ci95", (None, None))
                    row = {key: scored.get(key) for key in COLUMNS}
                    rows.append({"part": part, "estimator": who, "parameter": name, **row,
                                 "efficiency_low": low, "efficiency_high": high})  # fmt: skip
    return pd.DataFrame(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description="Estimators on the ready challenges.")
    parser.add_argument("presets", nargs="*", default=list(ABOUT))
    parser.add_argument("--trials", type=int, default=120, help="of map, in each mode")
    parser.add_argument("--estimator", action="append", help="default: all that are installed")
    options = parser.parse_args()
    RESULTS.mkdir(parents=True, exist_ok=True)
    installed = [one.name for one in known_estimators() if not one.missing]
    chosen = options.estimator or installed
    for preset in options.presets:
        if preset == "map":
            benchmark_all(chosen, options.trials)
            continue
        folder, scores = RESULTS / preset, RESULTS / f"{preset}-scores"
        run("iscat", "challenge", "make", "--preset", preset, "--out", folder, "--overwrite")
        estimators = [part for name in chosen for part in ("--estimator", name)]
        run("iscat", "challenge", "score", folder, *results_of(folder), *estimators,
            "--out", scores, "--overwrite")  # fmt: skip
        document = json.loads((scores / "challenge.json").read_text(encoding="utf-8"))
        table = table_of(document["parts"])
        table.to_csv(ROOT / f"challenge_{preset}.csv", index=False, float_format="%.4g")
        print(f"{preset}: {len(table)} rows; {scores / 'challenge.html'}")


if __name__ == "__main__":
    main()
