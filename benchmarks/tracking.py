"""Raw movies of particles that diffuse on a membrane: what is found, how exactly, and how fast.

    python benchmarks/tracking.py [--quick] [--median] [--movies N]

Movies of 128 × 128 × 1500 at 331 frames a second with 14 particles of 200 and 400 kDa, 0.15 and
0.8 µm²/s, and 4·10⁵ photoelectrons per pixel and frame, from ``tests/wanderers.py``, which shares
nothing with the package.  A fitted position is true where it is within 300 nm of a particle of its
frame; a track belongs to the particle of most of its positions, and is false where that is none.
Exit status 1 where a promise is broken.

``--median`` takes the median of each pixel for the background.  The peer is trackpy's ``locate``
on the same frames, over the same background, in turns; both rates are per second of wall time.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import trackpy
from scipy.optimize import linear_sum_assignment

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

from wanderers import SETTINGS, Wanderers, wander

import iscat_analysis as ia

RESULTS = Path(__file__).resolve().parent / "results"
SHAPE = (1500, 128, 128)
MOVIES = 10
NEAR_NM = 300.0
LONG = 10  # frames of a false track that counts
PEER_FRAMES = 100


def owners(truth: pd.DataFrame, rows: pd.DataFrame) -> np.ndarray:
    """Give the particle of every row, −1 where there is none near."""
    own = np.full(len(rows), -1)
    frames = dict(list(truth.groupby("frame")))
    for frame, at in rows.groupby("frame").indices.items():
        if frame not in frames:
            continue
        there = frames[frame]
        away = np.hypot(
            *(rows[k].to_numpy()[at][:, None] - there[k].to_numpy() for k in ("x_nm", "y_nm"))
        )
        i, j = linear_sum_assignment(np.minimum(away, 2 * NEAR_NM))
        near = away[i, j] < NEAR_NM
        own[at[i[near]]] = there["track"].to_numpy()[j[near]]
    return own


def judge(movie: Wanderers, result: ia.Result) -> tuple[dict[str, Any], pd.DataFrame]:
    """Count what was found of one movie; its tracks beside the truth."""
    rows, tracks = result.table, result.tracks.set_index("track")
    own = owners(movie.truth, rows)
    number = rows["track"].to_numpy()
    of_track = {n: pd.Series(own[number == n]).mode().iloc[0] for n in tracks.index}
    tracks["particle"] = pd.Series(of_track)
    particles = movie.truth.groupby("track")[["mass_kda", "d_um2_s"]].first()
    tracks = tracks.join(particles.add_suffix("_true"), on="particle")
    false = tracks[(tracks["particle"] < 0) & (tracks["n_frames"] > LONG)]
    true = own >= 0
    fitted = movie.truth.set_index(["track", "frame"]).reindex(
        pd.MultiIndex.from_arrays([own[true], rows["frame"].to_numpy()[true]])
    )
    ok = (rows["status"] == "ok").to_numpy()[true]
    pulls = {
        k: (
            (rows[k].to_numpy()[true] - fitted[k].to_numpy()) / rows[f"sigma_{k}"].to_numpy()[true]
        )[ok]
        for k in ("x_nm", "y_nm", "mass_kda")
    }
    counted = {
        "positions": int(movie.truth["inside"].sum()),
        "found": int(fitted["inside"].sum()),
        "not there": int((~true).sum()),
        "false tracks": len(false),
        "tracks": len(tracks),
        "pulls of positions": {k: round(float(np.std(v)), 3) for k, v in pulls.items()},
    }
    return counted, tracks[tracks["particle"] >= 0]


def summary(tracks: pd.DataFrame, column: str) -> dict[str, Any]:
    """Bias, pulls and spread over the bound of what tracks say."""
    kept = tracks[(tracks["status"] == "ok") & tracks[column].notna()]
    error = kept[column] - kept[f"{column}_true"]
    out: dict[str, Any] = {"tracks": len(kept)}
    by = {
        "all": kept,
        **{
            f"{m:g} kDa, {d:g} um2/s": part
            for (m, d), part in kept.groupby(["mass_kda_true", "d_um2_s_true"])
        },
    }
    for name, part in by.items():
        e, sigma, bound = (error[part.index], part[f"sigma_{column}"], part[f"crb_{column}"])
        weight = (part[f"{column}_true"] / bound) ** 2
        relative = e / part[f"{column}_true"]
        out[name] = {
            "bias": float(np.average(relative, weights=weight)),
            "bias_error": float(1 / np.sqrt(weight.sum())),
            "pull_mean": float((e / sigma).mean()),
            "pull_spread": float((e / sigma).std()),
            "spread_over_bound": float(np.sqrt(np.mean((e / bound) ** 2))),
            "of": len(part),
        }
    return out


def locate_rate(counts: np.ndarray) -> float:
    """Frames a second of trackpy's ``locate``, over the median of the movie."""
    trackpy.quiet()
    ratio = counts[:PEER_FRAMES] / np.median(counts, axis=0)
    ratio = (ratio / ratio.mean(axis=(1, 2), keepdims=True) - 1).astype(np.float32)
    begun = time.perf_counter()
    for frame in ratio:
        trackpy.locate(-frame, 7, preprocess=True, topn=20)
    return PEER_FRAMES / (time.perf_counter() - begun)


def main() -> int:
    parser = argparse.ArgumentParser(description="Particles that move: accuracy and speed.")
    parser.add_argument("--quick", action="store_true", help="one movie")
    parser.add_argument("--median", action="store_true", help="the median as background")
    parser.add_argument("--movies", type=int, default=MOVIES)
    options = parser.parse_args()
    settings = dict(SETTINGS)
    if options.median:
        settings["background.frames"] = "all"
    count = 1 if options.quick else options.movies
    counted, tables, seconds, peer = [], [], [], []
    warm = wander((40, 64, 64), seed=1, species=((400.0, 0.15, 2),))
    ia.fit_movie(warm.counts, settings=settings)
    for seed in range(count):
        movie = wander(SHAPE, seed=seed)
        begun = time.perf_counter()
        result = ia.fit_movie(movie.counts, settings=settings)
        seconds.append(time.perf_counter() - begun)
        peer.append(locate_rate(movie.counts))
        found, tracks = judge(movie, result)
        counted.append(found)
        tables.append(tracks.assign(movie=seed))
        print(seed, f"{seconds[-1]:.1f} s", found, flush=True)
    tracks = pd.concat(tables, ignore_index=True)
    positions = sum(c["positions"] for c in counted)
    megabytes = 2e-6 * np.prod(SHAPE)
    numbers = {
        "movies": count,
        "background": "median" if options.median else "tracks",
        "found": sum(c["found"] for c in counted) / positions,
        "not_there": sum(c["not there"] for c in counted) / positions,
        "false_tracks_per_movie": sum(c["false tracks"] for c in counted) / count,
        "mass": summary(tracks, "mass_kda"),
        "diffusion": summary(tracks, "d_um2_s"),
        "megabytes_per_second": float(megabytes / np.median(seconds)),
        "fits_per_second": float(positions / count / np.median(seconds)),
        "locate_frames_per_second": float(np.median(peer)),
        "frames_per_second": float(SHAPE[0] / np.median(seconds)),
    }
    print(json.dumps(numbers, indent=2))
    RESULTS.mkdir(exist_ok=True)
    name = "tracking-median" if options.median else "tracking"
    (RESULTS / f"{name}.json").write_text(json.dumps(numbers, indent=2) + "\n", encoding="utf-8")
    tracks.to_csv(RESULTS / f"{name}.csv", index=False)
    mass, diffusion = numbers["mass"]["all"], numbers["diffusion"]["all"]
    kept = {
        "97 % of the positions": numbers["found"] >= 0.97,
        "at most 0.2 false tracks in a movie": numbers["false_tracks_per_movie"] <= 0.2,
        "mass within 1 %": abs(mass["bias"]) < 0.01 + 2 * mass["bias_error"],
        "D within 3 %": abs(diffusion["bias"]) < 0.03 + 2 * diffusion["bias_error"],
    }
    for name, each in (("mass", mass), ("D", diffusion)):
        room = 2 / np.sqrt(2 * each["of"])  # two standard errors of a spread
        kept[f"pulls of {name}"] = abs(each["pull_spread"] - 1) < 0.1 + room
        kept[f"spread of {name} over its bound"] = each["spread_over_bound"] < 1.1 + room
    for promise, true in kept.items():
        print(f"{'kept  ' if true else 'BROKEN'}  {promise}")
    return 0 if options.median or all(kept.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
