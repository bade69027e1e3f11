"""Speed of answers from tables: 200 samples of 10 000 events compared with the first of them.

    python benchmarks/answers.py [--quick] [--search]

Oligomers of 66 kDa, of which the detector sees every other monomer, in CSV files; reading, the
choice of the species and all comparisons are timed together, in seconds of the clock and of the
processor.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402  # after the thread counts
import pandas as pd  # noqa: E402

from iscat_analysis.answers.comparing import compare_tables  # noqa: E402

RESULTS = Path(__file__).resolve().parent / "results"
EVENTS = 10_000
ALLOWED_S = 60.0
NOISE_KDA, THRESHOLD = 13.0, 5.0


def draw(random: np.random.Generator) -> pd.DataFrame:
    true = random.choice([66.0, 132.0, 264.0], 7 * EVENTS // 4, p=[4 / 7, 2 / 7, 1 / 7])
    true = np.concatenate([random.normal(true, 3.0), random.uniform(20, 600, EVENTS // 30)])
    sigma = random.uniform(6, 12, true.size)
    mass = random.normal(true, sigma)
    snr = random.normal(mass, np.sqrt(NOISE_KDA**2 - sigma**2)) / NOISE_KDA
    table = pd.DataFrame({"mass_kda": mass, "sigma_mass_kda": sigma, "snr": snr})
    return table[snr > THRESHOLD].sample(EVENTS, random_state=random)


def main() -> int:
    parser = argparse.ArgumentParser(description="Compare many samples.")
    parser.add_argument("--quick", action="store_true", help="20 samples")
    parser.add_argument("--search", action="store_true", help="find the species, name no ladder")
    options = parser.parse_args()
    number = 20 if options.quick else 200
    ladder = None if options.search else 66.0
    random = np.random.default_rng(1)
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{i}.csv" for i in range(number)]
        for path in paths:
            draw(random).to_csv(path, index=False)
        compare_tables(paths[:2], ladder=ladder)  # compiles
        clock, processor = time.perf_counter(), time.process_time()
        found = compare_tables(paths, ladder=ladder)
        took = {
            "seconds": time.perf_counter() - clock,
            "processor_seconds": time.process_time() - processor,
        }
    p = np.array([one.same.p_value for one in found])
    contents = {
        "samples": number,
        "events_each": EVENTS,
        "species": len(found[0].species),
        "p_below_0.05": float(np.mean(p < 0.05)),
        **took,
    }
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "answers.json").write_text(json.dumps(contents, indent=2) + "\n")
    print(json.dumps(contents, indent=2))
    return int(took["seconds"] > ALLOWED_S)


if __name__ == "__main__":
    sys.exit(main())
