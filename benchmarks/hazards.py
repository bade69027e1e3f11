"""Movies that break what an analysis takes for granted: the error bar is right, or a flag is set.

    python benchmarks/hazards.py [--quick] [--movies 5] [--seed N] [--rows NAME…] [--first]
                                 [--json FILE]

Every row of the table (``_hazard_rows.py``) is one kind of harm at some strengths.  Over all movies
of a row and strength it is told: how many particles have a row, and an ``ok`` one; the mean of
value over truth of the ``ok`` rows, weighted by the median σ of all of their mass, with its
standard error from their scatter; the systematic error that they state; the bias over both
together; the largest error of an ``ok`` row over its own σ and systematic error; ``ok`` rows that
are of no particle; the flags and the lines that name the cause.

A row keeps its promise where the bias of its ``ok`` rows lies within `SIGMAS` of both errors
together, no more than one of 500 is beyond `BEYOND`, and no more are of no particle than false
alarms allow; or where no row of a particle is ``ok``, or the movie is refused, and the cause is
named.  A control whose truth is changed afterwards must be found broken.  Exit status 1 where a row
breaks its promise, or the control does not.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from _hazard_movies import GAIN, NOMINAL, PIXEL_NM, Case
from _hazard_rows import ROWS, Row

import iscat_analysis as ia
from iscat_analysis.errors import DataError

RESULTS = Path(__file__).resolve().parent / "results"
SIGMAS, BEYOND, ONE_OF = 2.0, 5.0, 500
NEAR_PX, NEAR_FRAMES, LIGHT_PX = 3.0, 50, 20.0
FALSE_ALARMS = 0.1  # of a movie, as configured
CHANCE_FALSE = 3.0  # standard deviations of their number
SETUP: Mapping[str, Any] = {
    "camera.pixel_size_nm": PIXEL_NM,
    "camera.gain_e_per_adu": GAIN,
    "optics.focus_nm": NOMINAL.focus_nm,
    "background.method": "sliding",
    "particle.mass_kda": 205.0,
    "detection.false_alarms_per_movie": FALSE_ALARMS,
    "compute.workers": 1,
}
NOTHING = pd.DataFrame(
    {name: np.zeros(0) for name in ("value", "true", "sigma", "systematic")}
    | {name: np.zeros(0, dtype=str) for name in ("status", "flags")}
)


def masses(case: Case, result: ia.Result) -> pd.DataFrame:
    """Give the rows of a movie with their truth; not a number where they are of no particle."""
    truth = case.truth
    landed = result.table[result.table["mass_kda"] > 0].reset_index(drop=True)
    true = np.full(len(landed), np.nan)
    for frame, x, y, mass in zip(truth.frame, truth.x_px, truth.y_px, truth.mass_kda, strict=True):
        away = np.hypot(landed["x_px"] - x, landed["y_px"] - y)
        near = away[(away < NEAR_PX) & ((landed["frame"] - frame).abs() < NEAR_FRAMES)]
        if len(near):
            true[landed.loc[near.index, "mass_kda"].idxmax()] = mass
    return _table(landed, "mass_kda", true).loc[~(np.isnan(true) & _of_others(case, landed))]


def _of_others(case: Case, landed: pd.DataFrame) -> np.ndarray[Any, Any]:
    """Tell which rows lie in the light of particles that are not compared."""
    out = np.zeros(len(landed), dtype=bool)
    if case.others is not None:
        for x, y in zip(case.others.x_px, case.others.y_px, strict=True):
            out |= (np.hypot(landed["x_px"] - x, landed["y_px"] - y) < LIGHT_PX).to_numpy()
    return out


def diffusion(case: Case, result: ia.Result) -> pd.DataFrame:
    """Give the tracks of a movie with the coefficient that all of its particles have."""
    del case
    tracks = result.tracks[result.tracks["d_um2_s"].notna()].reset_index(drop=True)
    return _table(tracks, "d_um2_s", np.full(len(tracks), 0.3))


def _table(rows: pd.DataFrame, name: str, true: np.ndarray[Any, Any]) -> pd.DataFrame:
    systematic = rows.get(f"systematic_{name}", pd.Series(0.0, rows.index))
    return pd.DataFrame({
        "value": rows[name], "true": true, "sigma": rows[f"sigma_{name}"],
        "systematic": systematic, "status": rows["status"],
        "flags": rows["flags"].fillna("").astype(str),
    })  # fmt: skip


def analyse(row: Row, strength: float, seed: int) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Analyse one movie; its rows with their truth, and what is said of it."""
    case = row.make(strength, seed)
    setup = {} if row.diffusion else SETUP
    start = time.perf_counter()
    settings = {**setup, **case.settings}
    name = None if isinstance(case.counts, Path) else "movie"
    facts = {"particles": len(case.truth.frame), "searched": None}
    try:
        result = ia.fit_movie(case.counts, settings=settings, name=name)
    except DataError as error:  # a movie that is refused does not lie
        return NOTHING, {**facts, "said": [str(error)], "seconds": time.perf_counter() - start}
    table = (diffusion if row.diffusion else masses)(case, result)
    facts["searched"] = result.summary.get("landing", {}).get("searched_share")
    said = list(result.summary["warnings"])
    return table, {**facts, "said": said, "seconds": time.perf_counter() - start}


def judge(name: str, row: Row, strength: float, seeds: range) -> dict[str, Any]:
    """Analyse the movies of one strength and compare with the truth."""
    found = [analyse(row, strength, seed) for seed in seeds]
    table = pd.concat([each for each, _ in found], ignore_index=True)
    said = [text for _, each in found for text in each["said"]]
    good = table[table["status"] == "ok"]
    invented, used = int(good["true"].isna().sum()), good[good["true"].notna()]
    relative = used["value"] / used["true"]
    count = len(used)
    bias, error, stated = None, None, None
    if count > 1:
        # an error that grows with the mass would give weights that know how wrong a mass is
        usual = used.groupby("true")["sigma"].transform("median")
        weight = np.square(used["true"] / usual)
        weight /= weight.sum()
        bias = float(weight @ (relative - 1))
        spread = np.square(weight * (relative - 1 - bias)).sum() * count / (count - 1)
        error = float(np.sqrt(spread))
        stated = float(weight @ (used["systematic"] / used["value"].abs()))
    pulls = (used["value"] - used["true"]) / np.hypot(used["sigma"], used["systematic"])
    beyond = int((pulls.abs() > BEYOND).sum())
    alarms = FALSE_ALARMS * len(found)
    out: dict[str, Any] = {
        "row": name, "strength": strength, "unit": row.unit, "movies": len(found),
        "particles": sum(each["particles"] for _, each in found),
        "rows": int(table["true"].notna().sum()), "ok": count,
        "bias": bias, "bias_se": error, "stated": stated,
        "bias_over_both": None if bias is None or error is None or stated is None
        else bias / float(np.hypot(error, stated)),
        "pull_std": float(pulls.std()) if count > 1 else None,
        "worst": float(pulls.abs().max()) if count else None,
        "beyond": beyond, "invented": invented,
        "flags": dict(Counter(f for text in table["flags"] for f in text.split(";") if f)),
        "searched": _mean([each["searched"] for _, each in found]),
        "seconds": _mean([each["seconds"] for _, each in found]),
        "said": [text for text, _ in Counter(said).most_common()],
    }  # fmt: skip
    named = any(re.search(row.says, text) for text in (*said, *out["flags"]))
    enough = out["bias_over_both"] is not None
    out["named"] = named
    right = enough and abs(out["bias_over_both"]) <= SIGMAS and beyond <= count // ONE_OF
    few = invented <= alarms + CHANCE_FALSE * np.sqrt(alarms)
    out["kept"] = bool(few and (right or (not count and named)))
    return out


def _mean(values: list[Any]) -> float | None:
    known = [float(value) for value in values if value is not None]
    return sum(known) / len(known) if known else None


def line_of(one: Mapping[str, Any]) -> str:
    """Say what came of one strength."""

    def share(name: str, form: str = ".2%") -> str:
        return "–" if one[name] is None else format(one[name], form)

    flags = ", ".join(f"{number} {flag}" for flag, number in one["flags"].items())
    return (
        f"{'ok    ' if one['kept'] else 'BROKEN'} {one['row']} {one['strength']:g} {one['unit']}: "
        f"{one['ok']} ok of {one['rows']} found of {one['particles']}; bias "
        f"{share('bias', '+.2%')} ± {share('bias_se')}, stated {share('stated')}, "
        f"{share('bias_over_both', '+.1f')} of both; pulls {share('pull_std', '.2f')}, worst "
        f"{share('worst', '.1f')}, beyond {one['beyond']}; of no particle {one['invented']}; "
        f"searched {share('searched', '.0%')}; {share('seconds', '.0f')} s; "
        f"{'cause named; ' if one['named'] else ''}{flags or 'no flags'}"
    )


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one movie of each row, no judgement")
    parser.add_argument("--movies", type=int, default=5)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rows", nargs="*", default=[], metavar="NAME", help="parts of names")
    parser.add_argument("--first", action="store_true", help="the first strength of each row")
    parser.add_argument("--json", type=Path, default=RESULTS / "hazards.json", metavar="FILE")
    options = parser.parse_args()
    movies = 1 if options.quick else options.movies
    found, right = [], True
    for name, row in ROWS.items():
        if options.rows and not any(part in name for part in options.rows):
            continue
        for strength in row.strengths[:1] if options.quick or options.first else row.strengths:
            seeds = range(options.seed, options.seed + 10 * movies, 10)
            one = judge(name, row, strength, seeds)
            found.append(one)
            right &= one["kept"] != row.lies
            print(line_of(one), *one["said"], sep="\n       ", flush=True)
            options.json.parent.mkdir(parents=True, exist_ok=True)
            options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return int(not options.quick and not right)


if __name__ == "__main__":
    sys.exit(main())
