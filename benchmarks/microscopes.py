"""Movies of other microscopes, analysed with the nominal one: what is found, and what is not there.

    python benchmarks/microscopes.py [--quick] [--seed N]

One landing movie through each microscope of a table, made by the
quadrature of ``tests/instruments.py``, which shares nothing with the package.  An event counts as
true where its place is within 3 pixels of a particle that landed within 8 frames and the interval
of its frame; every other row that is not a side lobe is false.  Time is processor time over that of
the nominal movie in the same process.  Exit status 1 where a promise is broken; ``--quick`` takes
three microscopes.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

from instruments import Instrument, InstrumentMovie, Landings, draw_landings

from iscat_analysis.config import Config, load_config
from iscat_analysis.movie.camera import camera_from_config
from iscat_analysis.pipeline.landing import analyse_landings

SHAPE = (900, 160, 160)
COUNT = 36
FALSE, TIME = 0.05, 2.0
"""Promises: false events over the true ones, and time over that of a good model."""

MICROSCOPES: Mapping[str, Mapping[str, Any]] = {
    "as configured": {},
    "other emission": {"emission": "reciprocal"},
    "circular, analyser": {"circular": True, "analyzer": True},
    "mask of NA 0.6": {"mask_na": 0.6, "attenuation": 0.1},
    "20 nm spherical": {"aberrations_nm": {11: 20.0}},
    "25 nm coma": {"aberrations_nm": {8: 25.0}},
    "focus 100 nm away": {"focus_nm": -400.0},
    "NA 1.36": {"na": 1.36},
    "a sum of these": {
        "emission": "reciprocal", "circular": True, "analyzer": True, "focus_nm": -370.0,
        "na": 1.40, "mask_na": 0.6, "attenuation": 0.3, "reference_phase_deg": 12.0,
        "aberrations_nm": {5: 6.0, 6: -5.0, 7: 8.0, 8: -9.0, 11: 18.0},
    },
}  # fmt: skip


def nominal() -> Config:
    """Give the configuration with which every movie is analysed."""
    return load_config(
        None,
        [
            "camera.pixel_size_nm=84.0",
            "camera.gain_e_per_adu=4.0",
            "optics.focus_nm=-300.0",
            "optics.emission=dong2021",
            "particle.mass_kda=205",
            "calibration.gradient_per_kda=-3.1e-5",
            "background.method=sliding",
        ],
    )


def judge(name: str, landings: Landings, seed: int) -> dict[str, Any]:
    """Analyse one movie and count."""
    movie = InstrumentMovie(Instrument(**MICROSCOPES[name]), SHAPE, landings, seed=seed)
    config = nominal()
    said: list[str] = []
    start = time.process_time()
    result = analyse_landings(
        movie,
        config,
        camera_from_config(config.camera, (SHAPE[1], SHAPE[2]), movie.dtype),
        tell=said.append,
        progress=lambda *_: None,
    )
    seconds = time.process_time() - start
    table = result.table[result.table["status"] != "sidelobe"].reset_index(drop=True)
    free = np.ones(len(table), dtype=bool)
    found = 0
    for i in np.argsort(-landings.mass_kda):
        away = np.hypot(table["x_px"] - landings.x_px[i], table["y_px"] - landings.y_px[i])
        late = np.abs(table["frame"] - landings.frame[i])
        near = (away < 3) & (late <= 8 + table["frame_ci95"]) & free
        if near.any():
            free[int(np.argmin(np.where(near, away, np.inf)))] = False
            found += 1
    return {
        "found": found,
        "false": int(free.sum()),
        "ok": int((table["status"] == "ok").sum()),
        "seconds": seconds,
        "cause": next((text for text in said if "looks most like" in text), ""),
    }


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--seed", type=int, default=5)
    options = parser.parse_args()
    landings = draw_landings(SHAPE, COUNT, seed=options.seed)
    names = list(MICROSCOPES)[: 3 if options.quick else None]
    judge(names[0], replace(landings), options.seed + 2)  # compiles, and fills the caches
    base, broken = 0.0, False
    print(f"{COUNT} landings in {SHAPE[0]} frames of {SHAPE[2]} x {SHAPE[1]} pixels")
    for name in names:
        row = judge(name, landings, options.seed + 2)
        base = base or row["seconds"]
        ratio = row["seconds"] / base
        error = np.sqrt(max(row["false"], 1)) / COUNT
        bad = row["false"] > FALSE * COUNT or ratio > TIME
        broken |= bad
        print(
            f"{name:20s} found {row['found']:3d}  false {row['false']:2d} "
            f"({row['false'] / COUNT:.1%} ± {error:.1%})  ok {row['ok']:3d}  time x {ratio:.1f}"
            f"{'  BROKEN' if bad else ''}\n    {row['cause']}"
        )
    return int(broken and not options.quick)


if __name__ == "__main__":
    sys.exit(main())
