"""Score a challenge: results of any program, and estimators that are run on its counts."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.bounds import paper
from iscat_analysis.config import Config
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.executors import Executor, versions
from iscat_analysis.hashing import sha256_of_files
from iscat_analysis.movie import open_stack
from iscat_analysis.reading import is_folder
from iscat_analysis.records import FREE_PARAMETERS, PARAMETERS, FloatArray, Progress, silent
from iscat_analysis.study import (
    Limits,
    beside_best,
    limits_of_many,
    make_setting,
    matched,
    mean_interval,
    power_bound,
    resamples,
    score_estimates,
    trial_generator,
)
from iscat_contest.challenge import Challenge, manifest_sha256
from iscat_contest.estimators import Estimator
from iscat_contest.process import Answer, Job, job_of, run_estimators
from iscat_contest.results import (
    Results,
    match_movie,
    match_stacks,
    read_results,
    refuse_other_units,
    stem,
)

SEED = 1
"""Of the bootstrap and of the starts of estimators: the same score at any time."""

WINDOW = 60
"""Frames before and after a landing that estimators are given of a movie, at most."""

SHORTER = 10
"""Percent of landings whose frames do not suffice for the window, about."""


def score_challenge(
    challenge: Challenge,
    results: Sequence[Path],
    estimators: Sequence[Estimator] = (),
    *,
    time_limit_s: float = 600.0,
    executor: Executor | None = None,
    command: str = "",
    progress: Progress = silent,
) -> dict[str, Any]:
    """Score results and estimators, part by part."""
    groups = _groups(challenge)
    pixel = {
        group: float(challenge.manifest["parts"][parts[0]]["pixel_size_nm"])
        for group, parts in groups.items()
    }
    if len({path.name for path in results}) < len(results):
        raise DataError("two results have the same name, by which they are told apart; rename one")
    out: dict[str, Any] = {}
    hashes = {path.name: _sha256(path) for path in results}
    known = {group: _truth_of(challenge, parts) for group, parts in groups.items()}
    answers = _answers(challenge, groups, known, estimators, time_limit_s, executor, progress)
    used: set[str] = set()
    for group, parts in groups.items():
        about = challenge.manifest["parts"][parts[0]]
        events, limits = known[group]
        entries: dict[str, Any] = {}
        columns: dict[str, dict[str, FloatArray]] = {}
        for read, names in _participants(results, pixel[group], events):
            entry, found = _of_results(read, about, events, limits, challenge.told(parts[0]))
            if entry is not None:
                used |= names
                entries[read.name], columns[read.name] = entry, found
        for estimator in estimators:
            answer = answers[estimator.name][group]
            entry = _entry(answer.columns, events, limits)
            entries[estimator.name] = entry | {
                "failures": answer.failures,
                "about": estimator.about,
            }
            columns[estimator.name] = answer.columns
        out[group] = {
            "kind": about["kind"],
            "mode": about["mode"],
            "about": about["about"],
            "trials": len(events),
            "collected": float(np.mean(limits.collected)),
            "mass_kda": float(events["mass_kda"].mean()),
            "bounds": _bounds(limits),
            "estimators": entries,
            "paired": beside_best(
                columns,
                entries,
                events[list(PARAMETERS)].to_numpy(dtype=float),
                limits,
                resamples(len(events), SEED),
            ),
        }
    lost = [path.name for path in results if path.name not in used]
    if lost:
        raise DataError(
            f"{lost[0]}: no row of it is of a file of this challenge; its column file has to name "
            "them, or the table has to be called as the movie is"
        )
    manifest = challenge.manifest
    document = {
        "title": f"Challenge {manifest['name']}",
        "challenge": {
            "name": manifest["name"],
            "version": manifest["version"],
            "blind": manifest["blind"],
            "made_by": manifest["made_by"],
            "manifest_sha256": manifest_sha256(challenge.folder),
            "truth_sha256": manifest["truth_sha256"],
        },
        "results_sha256": hashes,
        "parts": out,
        "ranking": ranking(out),
        "seed": SEED,
        "command": command,
        "versions": versions(),
    }
    if manifest["name"] == "dong2021":
        document["table_1"] = table_1(out)
    return document


def score_tables(
    columns: Mapping[str, FloatArray], truths: FloatArray, limits: Limits, name: str, config: Config
) -> dict[str, Any]:
    """Score one table of one's own simulation, as a challenge of one part.

    Shapes: `columns` (n,) each, `truths` (n, 4).
    """
    events = pd.DataFrame(truths, columns=list(PARAMETERS))
    entry = _entry(columns, events, limits)
    part = {
        "kind": "table",
        "mode": config.fit.mode,
        "about": "",
        "trials": len(truths),
        "collected": float(np.mean(limits.collected)),
        "mass_kda": float(truths[:, 3].mean()),
        "bounds": _bounds(limits),
        "estimators": {name: entry},
        "paired": {},
    }
    return {"parts": {"results": part}, "ranking": ranking({"results": part}), "seed": SEED}


def ranking(parts: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Rank by the information that is kept: efficiency times the share answered, mean over all.

    A parameter that an estimator does not give counts as 0, and so does one below the bound.
    """
    names = sorted({who for part in parts.values() for who in part["estimators"]})
    found = []
    for who in names:
        kept, below = [], False
        for part in parts.values():
            entry = part["estimators"].get(who, {})
            for name in part["bounds"]:
                scored = entry.get(name, {})
                share = scored.get("answered", 0) / max(part["trials"], 1)
                efficiency = scored.get("efficiency_crb", 0.0)
                below |= bool(scored.get("below_bound", False))
                known = math.isfinite(efficiency) and not scored.get("below_bound", False)
                kept.append(share * efficiency if known else 0.0)
        found.append({"estimator": who, "kept": float(np.mean(kept)), "below_bound": below})
    return sorted(found, key=lambda one: (one["below_bound"], -one["kept"], one["estimator"]))


def table_1(parts: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Set what was achieved into Table 1 of Dong et al. (2021): per collected photon."""
    rows = []
    for group, part in parts.items():
        root = math.sqrt(part["collected"])
        for name, bounds in part["bounds"].items():
            unit = root / (part["mass_kda"] if name == "mass_kda" else 1.0)
            scheme = group.rpartition("_")[2]
            key = {"x_nm": "x", "y_nm": "y", "mass_kda": "mass"}.get(name, f"z_{scheme}")
            rows.append({
                "part": group, "parameter": name, "printed": paper.PRINTED.get(key),
                "qcrb": bounds["qcrb"] * unit, "crb": bounds["crb"] * unit,
                "achieved": {
                    who: entry[name]["rmse"] * unit
                    for who, entry in part["estimators"].items() if "rmse" in entry.get(name, {})
                },
            })  # fmt: skip
    return rows


def _participants(
    results: Sequence[Path], pixel_nm: float, events: pd.DataFrame
) -> list[tuple[Results, set[str]]]:
    """Read tables; those that are called as movies are, one for each, are one participant's."""
    movies = {stem(file) for file in events["file"]}
    out, own = [], []
    for path in results:
        read = read_results(path, pixel_nm)
        if read.name in movies and "file" not in read.table:
            own.append((replace(read, table=read.table.assign(file=read.name)), path))
        else:
            out.append((read, {path.name}))
    if own:
        tables = pd.concat([read.table for read, _ in own], ignore_index=True)
        notes = tuple(dict.fromkeys(note for read, _ in own for note in read.notes))
        name = own[0][1].resolve().parent.name
        out.append((Results(name, tables, notes), {path.name for _, path in own}))
    return out


def _groups(challenge: Challenge) -> dict[str, list[str]]:
    """Put movies of one kind together."""
    out: dict[str, list[str]] = {}
    for name in challenge.manifest["parts"]:
        out.setdefault(re.sub(r"_\d+$", "", name), []).append(name)
    return out


def _truth_of(challenge: Challenge, parts: Sequence[str]) -> tuple[pd.DataFrame, Limits]:
    """Give the events of parts of one kind, and their bounds with every frame that there is."""
    events = pd.DataFrame([one for part in parts for one in challenge.events(part)])
    config, about = challenge.true(parts[0]), challenge.manifest["parts"][parts[0]]
    frames = None
    side = config.fit.roi_px(float(about["pixel_size_nm"]))
    changes: dict[str, Any] = {"pixels": side, "x_nm": 0.0, "y_nm": 0.0}
    if about["kind"] == "movie":
        end = events["leave"].fillna(about["frames"]).astype(int)
        frames = [(int(a), int(b - a)) for a, b in zip(events["frame"], end, strict=True)]
        changes["photons_per_pixel"] = config.simulation.photons_per_pixel
    config = config.model_copy(update={"bounds": config.bounds.model_copy(update=changes)})
    free = FREE_PARAMETERS[about["mode"]]
    truths = events[list(PARAMETERS)].to_numpy(dtype=float)
    return events, limits_of_many(config, free, truths, frames)


def _of_results(
    read: Results, about: Mapping[str, Any], events: pd.DataFrame, limits: Limits, told: Config
) -> tuple[dict[str, Any] | None, dict[str, FloatArray]]:
    """Match one table with one part and score it; nothing where no row is of it."""
    pixel = float(about["pixel_size_nm"])
    extra: dict[str, Any] = {}
    if about["kind"] == "stacks":
        if "file" not in read.table and "event" not in read.table:
            return None, {}
        placed = match_stacks(read, events, pixel)
        if placed.notna().sum().sum() == 0:
            return None, {}
    elif "file" not in read.table and "frame" not in read.table:
        return None, {}  # numbers of stacks
    else:
        files = list(dict.fromkeys(events["file"]))
        matched, alarms = [], []
        for file in files:
            mine = events[events["file"] == file].reset_index(drop=True)
            one, rest = match_movie(read, mine, file, len(files), pixel)
            matched.append(one)
            alarms.append(rest)
        placed, false = pd.concat(matched, ignore_index=True), pd.concat(alarms, ignore_index=True)
        if not len(false) and not placed.notna().any(axis=None):
            return None, {}
        rate = told.detection.false_alarms_per_movie
        extra = _recall(placed, false, events, limits, rate, len(files))
    notes = list(read.notes)
    columns = {
        str(name): placed[name].to_numpy(dtype=float)
        for name in placed
        if str(name).removeprefix("sigma_") in (*PARAMETERS, "amplitude")
    }
    if "mass_kda" in columns:
        columns["mass_kda"] = np.abs(columns["mass_kda"])  # one that leaves has a negative mass
    elif "amplitude" in columns:
        truth = events["mass_kda"].to_numpy(dtype=float)
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = float(np.nanmedian(truth / columns["amplitude"]))
        columns["mass_kda"] = factor * columns["amplitude"]
        notes.append(f"masses are amplitudes × {factor:.6g}, the median of truth over amplitude")
    columns.pop("amplitude", None)
    return _entry(columns, events, limits) | extra | {"notes": notes}, columns


def _entry(
    columns: Mapping[str, FloatArray], events: pd.DataFrame, limits: Limits
) -> dict[str, Any]:
    truths = events[list(PARAMETERS)].to_numpy(dtype=float)
    scored = score_estimates(columns, truths, limits, resamples(len(truths), SEED))
    answered = max((one["answered"] for one in scored.values()), default=0)
    return {**scored, "trials": len(truths), "failed": len(truths) - answered}


def _recall(
    placed: pd.DataFrame,
    false: pd.DataFrame,
    events: pd.DataFrame,
    limits: Limits,
    rate: float,
    movies: int,
) -> dict[str, Any]:
    """Tell what was found of each mass, above as many false alarms as are allowed."""
    key = next((k for k in ("score", "mass_kda", "amplitude") if k in placed), None)
    found = placed.notna().any(axis=1).to_numpy()
    above = found.copy()
    if key is not None and len(false):
        rivals = np.sort(np.abs(false[key].to_numpy(dtype=float)))[::-1]
        allowed = math.floor(rate * movies)
        if allowed < rivals.size:
            above &= np.abs(placed[key].to_numpy(dtype=float)) > rivals[allowed]
    table = []
    mass = events["mass_kda"].to_numpy(dtype=float)
    for value in np.unique(mass):
        kind = mass == value
        weights = resamples(int(kind.sum()), SEED)
        share, interval = mean_interval(above[kind], weights)
        table.append({
            "mass_kda": float(value), "events": int(kind.sum()),
            "found": int(found[kind].sum()), "recall": share, "recall_ci95": interval,
            "matched_filter": float(np.mean([power_bound(s, rate) for s in limits.snr[kind]])),
        })  # fmt: skip
    return {"false_alarms": len(false), "false_alarms_per_movie": rate, "recall": table}


def _bounds(limits: Limits) -> dict[str, dict[str, float]]:
    def rms(values: FloatArray) -> float:
        return float(np.sqrt(np.mean(values**2)))

    return {
        name: {"crb": rms(limits.crb[:, i]), "qcrb": rms(limits.qcrb[:, i]),
               "holevo": rms(limits.holevo[:, i])}
        for i, name in enumerate(limits.free)
    }  # fmt: skip


def _answers(
    challenge: Challenge,
    groups: Mapping[str, Sequence[str]],
    known: Mapping[str, tuple[pd.DataFrame, Limits]],
    estimators: Sequence[Estimator],
    limit_s: float,
    executor: Executor | None,
    progress: Progress,
) -> dict[str, dict[str, Answer]]:
    """Run estimators on all parts, each in one process."""
    if not estimators:
        return {}
    cut = [_job(challenge, parts, known[group][0]) for group, parts in groups.items()]
    jobs = [one.job for one in cut]
    found = run_estimators(estimators, jobs, limit_s, executor, progress)
    out = {}
    for name, answers in found.items():
        whole = [one.whole(answer) for one, answer in zip(cut, answers, strict=True)]
        out[name] = dict(zip(groups, whole, strict=True))
    return out


@dataclass(frozen=True, eq=False)
class _Cut:
    """Regions cut out of files, where they lie, and of which events they are."""

    job: Job
    corners_nm: FloatArray
    rows: NDArray[np.int64]
    events: int
    window: int

    def whole(self, answer: Answer) -> Answer:
        """Put an answer into the rows of all events, at places in the whole field."""
        columns = {}
        for name, values in answer.columns.items():
            shift = {"y_nm": self.corners_nm[:, 0], "x_nm": self.corners_nm[:, 1]}.get(name, 0.0)
            columns[name] = np.full(self.events, np.nan)
            columns[name][self.rows] = values + shift
        left = self.events - len(self.rows)
        short = {f"fewer than {self.window} frames": left} if left else {}
        return replace(answer, columns=columns, failures=answer.failures | short)


def _job(challenge: Challenge, parts: Sequence[str], events: pd.DataFrame) -> _Cut:
    """Sum the counts of every event before and after, as an estimator is given them."""
    about, told = challenge.manifest["parts"][parts[0]], challenge.told(parts[0])
    camera = told.camera.assumed
    gain, offset = float(camera.gain_e_per_adu), float(camera.offset_adu)
    side = told.fit.roi_px(float(about["pixel_size_nm"]))
    stacks = about["kind"] == "stacks"
    room = _room(events, about)
    window = max(1, min(WINDOW, int(np.percentile(room, SHORTER))))
    n_before, n_after = (about["n_before"], about["n_after"]) if stacks else (window, window)
    sums: FloatArray = np.full((2, len(events), side, side), np.nan)
    corners, starts = np.zeros((len(events), 2)), np.empty((len(events), 4))
    truths = events[list(PARAMETERS)].to_numpy(dtype=float)
    pixel = float(about["pixel_size_nm"])
    for file, mine in events.groupby("file", sort=False):
        with open_stack(challenge.folder / str(file)) as stack:
            for i, event in zip(mine.index, mine.to_dict("records"), strict=True):
                random = trial_generator(SEED, 3000, int(i))
                place = np.rint(truths[i, 1::-1] / pixel + random.uniform(-1, 1, 2)).astype(int)
                corner = np.clip(place - side // 2, 0, np.array(stack.shape[1:]) - side)
                first = int(event["frame"])
                if room[i] < n_after:
                    continue
                rows, columns = (slice(c, c + side) for c in corner)
                for k, (a, b) in enumerate(((first - n_before, first), (first, first + n_after))):
                    if 0 <= a < b <= stack.shape[0]:
                        part = np.asarray(stack.read(a, b), dtype=float)[:, rows, columns]
                        sums[k, i] = ((part - offset) * gain).sum(axis=0)
                corners[i] = corner
                middle = np.full(2, (side - 1) / 2) if stacks else (place - corner).astype(float)
                starts[i, :2] = middle[::-1] * pixel
    photons = about.get("photons_per_pixel") or float(np.nanmean(sums[0]) / n_before)
    if not n_before:
        dark = not told.optics.interferes
        sums[0] = (told.background.level_e or 0.0) if dark else photons
    changes = {"n_before": n_before, "n_after": n_after, "photons_per_pixel": photons}
    told = told.model_copy(update={"bounds": told.bounds.model_copy(update=changes)})
    setting = make_setting(told, about["mode"])
    starts[:, 2:] = told.particle.nominal_height_nm, setting.truth[3]
    setting = replace(setting, truth=np.array([*setting.truth[:2], *starts[0, 2:]]))
    whole = np.flatnonzero(np.isfinite(sums).all(axis=(0, 2, 3)))
    job = job_of(setting, sums[0, whole], sums[1, whole], starts[whole])
    return _Cut(job, corners[whole] * pixel, whole, len(events), n_after)


def _room(events: pd.DataFrame, about: Mapping[str, Any]) -> NDArray[np.int64]:
    """Count the frames that are there both before an event and with its particle.

    Shapes: result (n,).
    """
    if about["kind"] == "stacks":
        return np.full(len(events), about["n_after"])
    end = events["leave"].fillna(about["frames"]).to_numpy(dtype=np.int64)
    first = events["frame"].to_numpy(dtype=np.int64)
    return np.asarray(np.minimum(first, end - first), dtype=np.int64)


def _sha256(path: Path) -> str:
    source = path / "fits.csv" if is_folder(path) else path
    try:
        return hashlib.sha256(source.read_bytes()).hexdigest()
    except OSError as error:
        raise DataError(f"{source}: cannot be read ({error.strerror})") from None


def score_own(truth: Path, results: Path, config: Config, *, command: str = "") -> dict[str, Any]:
    """Score one table against another, row by row or by event."""
    pixel = config.camera.pixel_size_nm
    if pixel is None:
        raise ConfigError(
            "camera.pixel_size_nm is needed: give it, as in camera.pixel_size_nm = 84.4"
        )
    mode = "joint" if config.fit.follows_tracks else config.fit.mode
    free = FREE_PARAMETERS[mode]
    known, found = (read_results(path, pixel, rows=True) for path in (truth, results))
    columns, truths = matched(found.table, known.table, config, free)
    placed = found.table if "event" not in known.table or "event" not in found.table else None
    if placed is not None:
        refuse_other_units(found.name, placed, known.table, pixel)
    if not columns:
        raise DataError(f"{results}: has none of the columns {', '.join(free)}")
    limits = limits_of_many(config, free, np.asarray(truths))
    scored = score_tables(columns, truths, limits, found.name, config)
    hashes = {path.name: sha256_of_files([path]) for path in (truth, results)}
    return {
        "title": "Estimates of one's own simulation",
        "challenge": None,
        "results_sha256": hashes,
        "command": command,
        "versions": versions(),
        **scored,
    }
