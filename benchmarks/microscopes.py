"""Movies of other microscopes, analysed with the nominal one: what is found, and what is not there.

    python benchmarks/microscopes.py [--auto] [--quick] [--seed N]… [--only TEXT]

One landing movie through each microscope of a table, made by the quadrature of
``tests/instruments.py``, which shares nothing with the package.  An event counts as true where its
place is within 3 pixels of a particle that landed within 8 frames and the interval of its frame;
every other row that is not a side lobe is false.  Exit status 1 where a promise is broken.

Without ``--auto`` the model stays wrong, and the promises are few false events and little time:
processor time over that of the nominal movie in the same process, the movies of all seeds together.

With ``--auto`` the optics are learned from the movie first.  The movies are 256 × 256 × 2000 with
150 steps, and `RANDOM` microscopes drawn at random join the table.  The promises, of isolated steps
(no other within two windows and 1.5 µm): recall, false events, species on a straight line of mass,
spread of the pulls, p-values, every learned parameter near the truth; where a twin is reported, it
or the twin.  A spread is known to 1/√(2n), so that one row may be off by two of these more, and
all rows together may not.

``--quick`` takes three microscopes, ``--only`` those whose name contains the text.  Movies with
background frames have ``microscopes_fixed.py``.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import kstest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

from instruments import Instrument, InstrumentMovie, Landings, draw_landings

from iscat_analysis.camera import camera_from_config
from iscat_analysis.config import Config, load_config
from iscat_analysis.fitting.results import DetectionResult
from iscat_analysis.fitting.run import Run
from iscat_analysis.instrument.learning import learn_optics
from iscat_analysis.landing.find import analyse_landings

RESULTS = Path(__file__).resolve().parent / "results"
SHAPE = (900, 160, 160)
COUNT = 36
SEEDS = (5, 31, 77)
"""Of a movie each; one false alarm is allowed in each movie, so that one says little."""

FALSE, TIME = 0.05, 2.0
"""Promises: false events over the true ones, and time over that of a good model."""

AUTO_SHAPE = (2000, 256, 256)
AUTO_COUNT = 150
RANDOM = 6
ISOLATED_PX = 1500.0 / 84.0
RECALL, AUTO_FALSE, LINEAR, PULL, UNIFORM_P, SIGMAS = 0.98, 0.02, 0.01, 0.1, 1e-3, 4.0
LEARNING_S = 20.0
"""Promises with ``--auto``; `LINEAR` and `PULL` are distances, relative, and of a spread from 1;
`LEARNING_S` is time on the wall of two idle cores, the kernels compiled."""

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


def draw_microscope(seed: int) -> dict[str, Any]:
    """Draw a microscope: focus, aperture, phase, aberrations, mask or none, either polarisation."""
    rng = np.random.default_rng(seed)
    size, sign = rng.uniform(5, 25, 7), rng.choice([-1, 1], 7)
    drawn: dict[str, Any] = {
        "focus_nm": rng.uniform(-500, 500),
        "na": rng.uniform(1.2, 1.49),
        "reference_phase_deg": rng.uniform(-30, 30),
        "aberrations_nm": dict(zip(range(5, 12), (size * sign).tolist(), strict=True)),
    }
    if rng.random() < 0.5:
        drawn |= {"circular": True, "analyzer": True}
    if rng.random() < 0.5:
        drawn |= {"mask_na": rng.uniform(0.4, 0.8), "attenuation": rng.uniform(0.1, 0.5)}
    return drawn


def nominal(*, learning: bool = False) -> Config:
    """Give the configuration with which every movie is analysed; one that learns knows no mass."""
    known = [
        "optics.emission=dong2021",
        "particle.mass_kda=205",
        "calibration.gradient_per_kda=-3.1e-5",
    ]
    return load_config(
        None,
        [
            "camera.pixel_size_nm=84.0",
            "camera.gain_e_per_adu=4.0",
            "optics.focus_nm=-300.0",
            "background.method=sliding",
            *([] if learning else known),
        ],
    )


@dataclass(frozen=True)
class Matched:
    """Row of the table for each step of a movie, −1 if none, and the rows that are no step."""

    rows: np.ndarray
    false: int


def match(landings: Landings, table: pd.DataFrame) -> Matched:
    """Give every step, heavy ones first, the nearest row that is still free."""
    free = np.ones(len(table), dtype=bool)
    rows = np.full(len(landings.frame), -1)
    for i in np.argsort(-landings.mass_kda):
        away = np.hypot(table["x_px"] - landings.x_px[i], table["y_px"] - landings.y_px[i])
        late = np.abs(table["frame"] - landings.frame[i])
        near = (away < 3) & (late <= 8 + table["frame_ci95"]) & free
        if near.any():
            rows[i] = int(np.argmin(np.where(near, away, np.inf)))
            free[rows[i]] = False
    return Matched(rows, int(free.sum()))


def analyse(movie: InstrumentMovie, config: Config, said: list[str]) -> DetectionResult:
    """Analyse a movie and keep what the user is told."""
    return analyse_landings(
        movie,
        config,
        camera_from_config(config.camera, movie.shape[1:], movie.dtype),
        Run(notify=said.append),
    )


def counted(result: DetectionResult) -> pd.DataFrame:
    """Give the rows of a result that are not side lobes."""
    return result.fits[result.fits["status"] != "sidelobe"].reset_index(drop=True)


def judge(name: str, seed: int) -> dict[str, Any]:
    """Analyse one movie with the nominal model and count."""
    landings = draw_landings(SHAPE, COUNT, seed=seed)
    movie = InstrumentMovie(Instrument(**MICROSCOPES[name]), SHAPE, landings, seed=seed + 2)
    said: list[str] = []
    start = time.process_time()
    result = analyse(movie, nominal(), said)
    seconds = time.process_time() - start
    cause = next((text for text in said if "looks most like" in text), "")
    return tally(landings, counted(result), seconds, cause)


def tally(landings: Landings, table: pd.DataFrame, seconds: float, cause: str) -> dict[str, Any]:
    """Count what was found of one movie, and what is not there."""
    matched = match(landings, table)
    return {
        "particles": len(landings.frame),
        "found": int((matched.rows >= 0).sum()),
        "false": matched.false,
        "ok": int((table["status"] == "ok").sum()),
        "seconds": seconds,
        "cause": cause,
    }


def compare(
    names: Sequence[str], judge_one: Callable[[str, int], dict[str, Any]], seeds: Sequence[int]
) -> bool:
    """Print what a wrong model does, the movies of all seeds together; True if too much."""
    for name in dict.fromkeys(["as configured", names[-1]]):  # compiles, and fills the caches
        judge_one(name, seeds[0])  # what names the cause is compiled, too
    base, broken = 0.0, False
    for name in names:
        rows = [judge_one(name, seed) for seed in seeds]
        total = {
            key: sum(row[key] for row in rows)
            for key in ("particles", "found", "false", "ok", "seconds")
        }
        base = base or total["seconds"]
        ratio = total["seconds"] / base
        share = total["false"] / total["particles"]
        error = np.sqrt(max(total["false"], 1)) / total["particles"]
        bad = share > FALSE or ratio > TIME
        broken |= bad
        print(
            f"{name:20s} found {total['found']:3d} of {total['particles']}  "
            f"false {total['false']:2d} ({share:.1%} ± {error:.1%})  ok {total['ok']:3d}  "
            f"time x {ratio:.1f}{'  BROKEN' if bad else ''}\n    {rows[0]['cause']}",
            flush=True,
        )
    return broken


def isolated(landings: Landings, window: int) -> np.ndarray:
    """Tell which steps have no other within two windows and 1.5 µm."""
    gap = np.abs(landings.frame[:, None] - landings.frame)
    apart = np.hypot(landings.x_px[:, None] - landings.x_px, landings.y_px[:, None] - landings.y_px)
    return np.asarray(((gap < 2 * window) & (apart < ISOLATED_PX)).sum(axis=1) == 1)


def parameter_pulls(found: Mapping[str, Any], truth: Instrument) -> dict[str, float]:
    """Give learned minus true over its standard error, of the twin where that is nearer."""
    true = {
        "focus_nm": truth.focus_nm, "na": truth.na,
        "reference_phase_deg": truth.reference_phase_deg, "mask_na": truth.mask_na,
        "attenuation": truth.attenuation,
    } | {f"z{j}": size for j, size in truth.aberrations_nm.items()}  # fmt: skip
    rows = [row for row in found.get("parameters", []) if row["state"] == "measured"]
    best: dict[str, float] = {}
    for one in [{}, *([found["twin"]["settings"]] if found.get("twin") else [])]:
        pulls = {}
        for row in rows:
            off = one.get(row["parameter"], row["value"]) - true.get(row["parameter"], 0.0)
            if row["parameter"] in ("reference_phase_deg", "polarization_deg"):
                off = (off + 90) % 180 - 90  # half a turn: the sign of the contrast; the same axis
            pulls[row["parameter"]] = off / row["sigma"]
        if not best or max(map(abs, pulls.values())) < max(map(abs, best.values())):
            best = pulls
    return best


def learn(name: str, changes: Mapping[str, Any], seed: int) -> dict[str, Any]:
    """Learn the optics from one movie, analyse it, and judge both."""
    truth = Instrument(**{"emission": "reciprocal", **changes})
    landings = draw_landings(AUTO_SHAPE, AUTO_COUNT, seed=seed)
    movie = InstrumentMovie(truth, AUTO_SHAPE, landings, seed=seed + 1)
    config = nominal(learning=True)
    camera = camera_from_config(config.camera, movie.shape[1:], movie.dtype)
    start = time.perf_counter()
    config, found, findings = learn_optics(movie, config, camera)
    said = [finding.text for finding in findings]
    learning = time.perf_counter() - start
    result = analyse(movie, config, said)
    table = counted(result)
    matched = match(landings, table)
    alone = isolated(landings, int(result.summary["window_frames"]))
    hit = matched.rows >= 0
    use = alone & hit
    rows = table.iloc[matched.rows[use]].reset_index(drop=True)
    good = (rows["status"] == "ok").to_numpy()
    rows, mass = rows[good], landings.mass_kda[use][good]
    species = np.unique(mass)
    means = np.array([rows["mass_kda"][mass == m].mean() for m in species])
    errors = np.array([rows["mass_kda"][mass == m].sem() for m in species])
    line = np.polyfit(species, means, 1, w=1 / errors)
    away = (rows["mass_kda"] - np.polyval(line, mass)) / rows["sigma_mass_kda"]
    off = {"mass": away.to_numpy()}
    for axis, place in (("x", landings.x_px), ("y", landings.y_px)):
        error = rows[f"{axis}_nm"] - 84.0 * place[use][good]
        off[axis] = (error / rows[f"sigma_{axis}_nm"]).to_numpy()
    return {
        "name": name,
        "seed": seed,
        "isolated": int(alone.sum()),
        "missed": int((alone & ~hit).sum()),
        "found": int(hit.sum()),
        "false": matched.false,
        "ok": int((table["status"] == "ok").sum()),
        "linearity": (np.polyval(line, species) / means - 1).tolist(),
        "linearity_se": (errors / means).tolist(),
        "pulls": {key: value.tolist() for key, value in off.items()},
        "uniform_p": float(kstest(rows["p_value"], "uniform").pvalue),
        "calibrated": bool(found.get("calibrated")),
        "twin": bool(found.get("twin")),
        "parameters": parameter_pulls(found, truth),
        "seconds_learning": learning,
        "seconds": time.perf_counter() - start,
        "said": said,
    }


def spread(values: Any) -> tuple[float, float]:
    """Give a standard deviation and its standard error."""
    return float(np.std(values)), 1 / np.sqrt(2 * len(values))


def broken_promises(row: Mapping[str, Any]) -> Iterator[str]:
    """Name what a row of the table does not keep."""
    if row["missed"] > (1 - RECALL) * row["isolated"]:
        yield "recall"
    if row["false"] > AUTO_FALSE * AUTO_COUNT:
        yield "false events"
    for share, error in zip(row["linearity"], row["linearity_se"], strict=True):
        if abs(share) > LINEAR + 2 * error:
            yield "linearity"
    for key, values in row["pulls"].items():
        size, error = spread(values)
        if abs(size - 1) > PULL + 2 * error:
            yield f"pulls of {key}"
    if row["uniform_p"] < UNIFORM_P:
        yield "p-values"
    for key, pull in row["parameters"].items():
        if abs(pull) > SIGMAS:
            yield key
    if row["seconds_learning"] > LEARNING_S:
        yield "time"


def print_learned(row: Mapping[str, Any], broken: list[str]) -> None:
    """Print what was found of one movie."""
    lost, many = row["missed"], row["isolated"]
    recall = 1 - lost / many
    error = np.sqrt(max(lost, 1) * (many - lost)) / many**1.5
    pulls = {key: spread(values) for key, values in row["pulls"].items()}
    print(
        f"{row['name']}: found {row['found']} of {AUTO_COUNT}; isolated {recall:.1%} ± {error:.1%} "
        f"of {many}; false {row['false']} ± {np.sqrt(max(row['false'], 1)):.0f}; ok {row['ok']}\n"
        "    line of mass "
        + ", ".join(
            f"{o:+.2%} ± {e:.2%}"
            for o, e in zip(row["linearity"], row["linearity_se"], strict=True)
        )
        + "; pulls "
        + ", ".join(f"{key} {size:.3f} ± {error:.3f}" for key, (size, error) in pulls.items())
        + f"; p-values uniform p = {row['uniform_p']:.2g}\n    parameters "
        + (", ".join(f"{key} {pull:+.1f}σ" for key, pull in row["parameters"].items()) or "none")
        + (", a twin" if row["twin"] else "")
        + f"; {row['seconds_learning']:.0f} s of {row['seconds']:.0f} s\n    "
        + "\n    ".join(row["said"])
    )
    if broken:
        print(f"    BROKEN: {', '.join(broken)}")
    sys.stdout.flush()


def learn_all(microscopes: Mapping[str, Mapping[str, Any]], names: list[str], seed: int) -> bool:
    """Learn and judge those of the microscopes that are named; True if a promise is broken."""
    rows, broken = [], False
    for number, (name, changes) in enumerate(microscopes.items()):
        if name not in names:
            continue
        rows.append(learn(name, changes, seed + 10 * number))
        faults = list(broken_promises(rows[-1]))
        print_learned(rows[-1], faults)
        broken |= bool(faults)
    for key in ("mass", "x", "y"):
        size, error = spread(np.concatenate([row["pulls"][key] for row in rows]))
        print(f"all: pulls of {key} {size:.3f} ± {error:.3f}")
        broken |= abs(size - 1) > PULL
    parameters = np.concatenate([list(row["parameters"].values()) for row in rows])
    if parameters.size:
        size, error = spread(parameters)
        print(f"all: pulls of {parameters.size} parameters {size:.2f} ± {error:.2f}")
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "microscopes.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return broken


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--auto", action="store_true")
    parser.add_argument("--seed", type=int, action="append")
    parser.add_argument("--only", default="")
    options = parser.parse_args()
    drawn = {f"random {i}": draw_microscope(1000 + i) for i in range(1, RANDOM + 1)}
    table = MICROSCOPES | drawn if options.auto else MICROSCOPES
    names = [name for name in table if options.only in name][: 3 if options.quick else None]
    seeds = options.seed or SEEDS
    if options.auto:
        return int(learn_all(table, names, seeds[0]))
    print(f"{COUNT} landings in {SHAPE[0]} frames of {SHAPE[2]} x {SHAPE[1]} pixels, seeds {seeds}")
    return int(compare(names, judge, seeds) and not options.quick)


if __name__ == "__main__":
    sys.exit(main())
