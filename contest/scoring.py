"""Score results of any program and estimators that are run, and write the scores.

A folder of scores can be cited: JSON, page, BibTeX, and an archive.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis import study
from iscat_analysis.bounds import paper
from iscat_analysis.config import Config
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.executors import versions
from iscat_analysis.files import sha256_of_files, whole_file
from iscat_analysis.movie import open_stack
from iscat_analysis.reading import LARGEST_TEXT_BYTES, OF_DAMAGE, is_folder, open_regular
from iscat_analysis.records import FREE_PARAMETERS, PARAMETERS, FloatArray, Progress, silent
from iscat_analysis.report import CHALLENGE_NAMES, atomic_folder, render_challenge
from iscat_analysis.schemas import to_json
from iscat_analysis.study import Limits, matched, resamples, score_estimates
from iscat_contest.challenge import Challenge, manifest_sha256
from iscat_contest.estimators import BUILT_IN, TRUSTED, Estimator
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


@dataclass(frozen=True, eq=False)
class _Group:
    """Parts of one kind: what is known of them, their particles, and bounds with all frames."""

    about: Mapping[str, Any]
    told: Config
    events: pd.DataFrame
    limits: Limits

    @property
    def pixel_nm(self) -> float:
        """Side of a pixel [nm]."""
        return float(self.about["pixel_size_nm"])

    @property
    def are_stacks(self) -> bool:
        """Whether each file holds one particle."""
        return bool(self.about["kind"] == "stacks")


def score_challenge(
    challenge: Challenge,
    results: Sequence[Path],
    estimators: Sequence[Estimator] = (),
    *,
    time_limit_s: float = 600.0,
    command: str = "",
    progress: Progress = silent,
) -> dict[str, Any]:
    """Score results and estimators, part by part."""
    if len({path.name for path in results}) < len(results):
        raise DataError("two results have the same name, by which they are told apart; rename one")
    groups, manifest = _groups(challenge), challenge.manifest
    files = {path: path / "fits.csv" if is_folder(path) else path for path in results}
    hashes = {path.name: sha256_of_files([file]) for path, file in files.items()}
    cuts = [_job(challenge, group) for group in groups.values()] if estimators else []
    answers = run_estimators(estimators, [cut.job for cut in cuts], time_limit_s, progress)
    parts: dict[str, Any] = {}
    used: set[str] = set()
    for number, (name, group) in enumerate(groups.items()):
        entries: dict[str, Any] = {}
        columns: dict[str, dict[str, FloatArray]] = {}
        for read, names in _participants(results, group):
            if (found := _of_results(read, group)) is not None:
                used |= names
                entries[read.name], columns[read.name] = found
        for one in estimators:
            answer = cuts[number].whole(answers[one.name][number])
            entry = _entry(answer.columns, group.limits)
            entries[one.name] = {**entry, "failures": answer.failures, "about": one.about}
            columns[one.name] = answer.columns
        about = {key: group.about[key] for key in ("kind", "mode", "about")}
        parts[name] = about | _part(group.limits, entries)
        parts[name]["paired"] = study.beside_best(columns, entries, group.limits, SEED)
    lost = [path.name for path in results if path.name not in used]
    if lost:
        raise DataError(
            f"{lost[0]}: no row of it is of a file of this challenge; its column file has to name "
            "them, or the table has to be called as the movie is"
        )
    about = {key: manifest[key] for key in ("name", "version", "blind", "made_by", "truth_sha256")}
    about["manifest_sha256"] = manifest_sha256(challenge.folder)
    if not {*estimators} <= {*BUILT_IN}:
        about["estimators"] = TRUSTED
    document = _document(f"Challenge {manifest['name']}", about, hashes, parts, command)
    return document | ({"table_1": table_1(parts)} if manifest["name"] == "dong2021" else {})


def _document(
    title: str,
    about: Mapping[str, Any] | None,
    hashes: Mapping[str, str],
    parts: Mapping[str, Any],
    command: str,
) -> dict[str, Any]:
    return {
        "title": title,
        "challenge": about,
        "results_sha256": hashes,
        "parts": parts,
        "ranking": ranking(parts),
        "seed": SEED,
        "command": command,
        "versions": versions(),
    }


def _part(limits: Limits, entries: Mapping[str, Any]) -> dict[str, Any]:
    def rms(values: FloatArray) -> float:
        return float(np.sqrt(np.mean(values**2)))

    kinds = {"crb": limits.crb, "qcrb": limits.qcrb, "holevo": limits.holevo}
    return {
        "trials": len(limits),
        "collected": float(np.mean(limits.collected)),
        "mass_kda": float(limits.truths[:, 3].mean()),
        "bounds": {
            name: {kind: rms(values[:, i]) for kind, values in kinds.items()}
            for i, name in enumerate(limits.free)
        },
        "estimators": entries,
        "paired": {},
    }


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


def _participants(results: Sequence[Path], group: _Group) -> list[tuple[Results, set[str]]]:
    """Read tables; those that are called as movies are, one for each, are one participant's."""
    movies = {stem(file) for file in group.events["file"]}
    out, own = [], []
    for path in results:
        read = read_results(path, group.pixel_nm)
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


def _groups(challenge: Challenge) -> dict[str, _Group]:
    """Put movies of one kind together, and compute their bounds."""
    names: dict[str, list[str]] = {}
    for name in challenge.manifest["parts"]:
        names.setdefault(re.sub(r"_\d+$", "", name), []).append(name)
    out = {}
    for group, parts in names.items():
        about = challenge.manifest["parts"][parts[0]]
        events = pd.DataFrame([one for part in parts for one in challenge.events(part)])
        config, frames = challenge.true(parts[0]), None
        side = config.fit.roi_px(float(about["pixel_size_nm"]))
        changes: dict[str, Any] = {"pixels": side, "x_nm": 0.0, "y_nm": 0.0}
        if about["kind"] == "movie":
            end = events["leave"].fillna(about["frames"]).astype(int)
            frames = [(int(a), int(b - a)) for a, b in zip(events["frame"], end, strict=True)]
            changes["photons_per_pixel"] = config.simulation.photons_per_pixel
        config = config.model_copy(update={"bounds": config.bounds.model_copy(update=changes)})
        truths = events[list(PARAMETERS)].to_numpy(dtype=float)
        limits = study.limits_of_many(config, FREE_PARAMETERS[about["mode"]], truths, frames)
        out[group] = _Group(about, challenge.told(parts[0]), events, limits)
    return out


def _of_results(
    read: Results, group: _Group
) -> tuple[dict[str, Any], dict[str, FloatArray]] | None:
    """Match one table with one group and score it; nothing where no row is of it."""
    extra: dict[str, Any] = {}
    if not {"file", "event" if group.are_stacks else "frame"} & set(read.table):
        return None
    if group.are_stacks:
        placed = match_stacks(read, group.events, group.pixel_nm)
        rest = placed.iloc[:0]
    else:
        files = group.events.groupby("file", sort=False)
        matched = [
            match_movie(read, mine.reset_index(drop=True), str(file), len(files), group.pixel_nm)
            for file, mine in files
        ]
        placed, rest = (pd.concat(part, ignore_index=True) for part in zip(*matched, strict=True))
        extra = _recall(placed, rest, group, len(files))
    if not len(rest) and not placed.notna().any(axis=None):
        return None
    notes = list(read.notes)
    columns = {
        str(name): placed[name].to_numpy(dtype=float)
        for name in placed
        if str(name).removeprefix("sigma_") in (*PARAMETERS, "amplitude")
    }
    amplitude = columns.pop("amplitude", None)
    if "mass_kda" in columns:
        columns["mass_kda"] = np.abs(columns["mass_kda"])  # one that leaves has a negative mass
    elif amplitude is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = float(np.nanmedian(group.limits.truths[:, 3] / amplitude))
        columns["mass_kda"] = factor * amplitude
        notes.append(f"masses are amplitudes × {factor:.6g}, the median of truth over amplitude")
    return _entry(columns, group.limits) | extra | {"notes": notes}, columns


def _entry(columns: Mapping[str, FloatArray], limits: Limits) -> dict[str, Any]:
    scored = score_estimates(columns, limits, SEED)
    answered = max((one["answered"] for one in scored.values()), default=0)
    return {**scored, "trials": len(limits), "failed": len(limits) - answered}


def _recall(placed: pd.DataFrame, rest: pd.DataFrame, group: _Group, movies: int) -> dict[str, Any]:
    """Tell what was found of each mass, above as many false alarms as are allowed."""
    rate = group.told.detection.false_alarms_per_movie
    key = next((k for k in ("score", "mass_kda", "amplitude") if k in placed), None)
    found = placed.notna().any(axis=1).to_numpy()
    above = found.copy()
    allowed = math.floor(rate * movies)
    if key is not None and allowed < len(rest):
        rivals = np.sort(np.abs(rest[key].to_numpy(dtype=float)))[::-1]
        above &= np.abs(placed[key].to_numpy(dtype=float)) > rivals[allowed]
    table = []
    masses = group.limits.truths[:, 3]
    for value in np.unique(masses):
        kind = masses == value
        share, interval = study.mean_interval(above[kind], resamples(int(kind.sum()), SEED))
        best = [study.power_bound(s, rate) for s in group.limits.snr[kind]]
        counts = {"events": int(kind.sum()), "found": int(found[kind].sum())}
        recall = {"recall": share, "recall_ci95": interval, "matched_filter": float(np.mean(best))}
        table.append({"mass_kda": float(value), **counts, **recall})
    return {"false_alarms": len(rest), "false_alarms_per_movie": rate, "recall": table}


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


def _job(challenge: Challenge, group: _Group) -> _Cut:
    """Sum the counts of every event before and after, as an estimator is given them."""
    about, told, events, pixel = group.about, group.told, group.events, group.pixel_nm
    camera = told.camera.assumed
    gain, offset = float(camera.gain_e_per_adu), float(camera.offset_adu)
    side = told.fit.roi_px(pixel)
    if group.are_stacks:
        room = np.full(len(events), about["n_after"])
        n_before, n_after = about["n_before"], about["n_after"]
    else:  # frames that are there both before an event and with its particle
        end = events["leave"].fillna(about["frames"])
        room = np.minimum(events["frame"], end - events["frame"]).to_numpy(dtype=int)
        # percent of landings whose frames do not suffice for the window, about
        n_before = n_after = max(1, min(WINDOW, int(np.percentile(room, 10))))
    sums: FloatArray = np.full((2, len(events), side, side), np.nan)
    corners, starts = np.zeros((len(events), 2)), np.empty((len(events), 4))
    truths = group.limits.truths
    for file, mine in events.groupby("file", sort=False):
        with open_stack(challenge.folder / str(file)) as stack:
            if side > min(stack.shape[1:]):
                raise DataError(f"{file}: is smaller than fit.roi_nm, {side} pixels; lower it")
            for i, first in mine["frame"].items():
                random = study.trial_generator(SEED, 3000, int(i))
                place = np.rint(truths[i, 1::-1] / pixel + random.uniform(-1, 1, 2)).astype(int)
                corner = np.clip(place - side // 2, 0, np.array(stack.shape[1:]) - side)
                if room[i] < n_after:
                    continue
                rows, columns = (slice(c, c + side) for c in corner)
                for k, (a, b) in enumerate(((first - n_before, first), (first, first + n_after))):
                    if 0 <= a < b <= stack.shape[0]:
                        part = np.asarray(stack.read(a, b), dtype=float)[:, rows, columns]
                        sums[k, i] = ((part - offset) * gain).sum(axis=0)
                corners[i] = corner
                middle = np.full(2, (side - 1) / 2) if group.are_stacks else place - corner
                starts[i, :2] = middle[::-1] * pixel
    photons = about.get("photons_per_pixel") or float(np.nanmean(sums[0]) / n_before)
    if not n_before:
        sums[0] = photons if told.optics.interferes else told.background.level_e or 0.0
    changes = {"n_before": n_before, "n_after": n_after, "photons_per_pixel": photons}
    told = told.model_copy(update={"bounds": told.bounds.model_copy(update=changes)})
    setting = study.make_setting(told, about["mode"])
    starts[:, 2:] = told.particle.nominal_height_nm, setting.truth[3]
    setting = replace(setting, truth=np.array([*setting.truth[:2], *starts[0, 2:]]))
    whole = np.flatnonzero(np.isfinite(sums).all(axis=(0, 2, 3)))
    job = job_of(setting, sums[0, whole], sums[1, whole], starts[whole])
    return _Cut(job, corners[whole] * pixel, whole, len(events), n_after)


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
    limits = study.limits_of_many(config, free, np.asarray(truths))
    entries = {found.name: _entry(columns, limits)}
    part = {"kind": "table", "mode": config.fit.mode, "about": ""}
    part |= _part(limits, entries)
    hashes = {path.name: sha256_of_files([path]) for path in (truth, results)}
    title = "Estimates of one's own simulation"
    return _document(title, None, hashes, {"results": part}, command)


_EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest that an archive can name: no date is part of a score


def write_scores(document: Mapping[str, Any], folder: Path, *, overwrite: bool = False) -> Path:
    """Write ``challenge.json``, ``challenge.html`` and ``benchmark.bib``."""
    with atomic_folder(folder, overwrite, known=CHALLENGE_NAMES) as building:
        text = to_json("challenge", document) + "\n"
        (building / "challenge.json").write_text(text, encoding="utf-8")
        (building / "challenge.html").write_text(render_challenge(document), encoding="utf-8")
        (building / "benchmark.bib").write_text(bibtex(document["title"], text), encoding="utf-8")
    return folder


def bibtex(title: str, document: str) -> str:
    """Cite a score by the hash of its JSON, and the program that made it."""
    digest = hashlib.sha256(document.encode()).hexdigest()
    number = version("iscat-analysis")
    return (
        f"@misc{{iscat_benchmark_{digest[:8]},\n"
        f"  title        = {{{title}: estimators beside the Cram{{\\'e}}r--Rao bounds}},\n"
        f"  howpublished = {{iscat-analysis {number}}},\n"
        f"  note         = {{SHA-256 of the scores {digest}}},\n"
        "}\n\n"
        "@software{iscat_analysis,\n"
        "  author  = {{The iscat-analysis developers}},\n"
        "  title   = {iscat-analysis},\n"
        f"  version = {{{number}}},\n"
        "}\n"
    )


def _is_ours(archive: Path) -> bool:
    """Tell whether an archive holds what its list of sums names, and nothing else."""
    try:
        with open_regular(archive) as file, zipfile.ZipFile(file) as packed:
            names = packed.namelist()
            folder = names[0].partition("/")[0]
            with packed.open(f"{folder}/SHA256SUMS") as sums:
                lines = sums.read(LARGEST_TEXT_BYTES).decode().splitlines()
    except (zipfile.BadZipFile, zlib.error, *OF_DAMAGE):
        return False
    listed = (line.partition("  ")[2] for line in lines)
    return {*names} == {f"{folder}/{name}" for name in (*listed, "SHA256SUMS", ".zenodo.json")}


def write_archive(folder: Path, archive: Path, *, title: str, overwrite: bool = False) -> None:
    """Pack a folder with what a repository of data asks for; equal scores give equal bytes."""
    if archive.exists() and not overwrite:
        raise DataError(f"{archive}: exists already; give another name, or pass `overwrite`")
    if archive.exists() and not _is_ours(archive):
        raise DataError(f"{archive}: is no archive of ours, and is left alone; give another name")
    files = sorted(p for p in folder.rglob("*") if p.is_file() and not p.name.startswith("."))
    about = {
        "title": title,
        "upload_type": "dataset",
        "description": "Estimators of particles in interferometric scattering movies, scored "
        "against classical and quantum Cramér–Rao bounds.",
        "creators": [{"name": "give the authors here"}],
        "keywords": ["iSCAT", "mass photometry", "Cramér-Rao bound", "benchmark"],
        "version": version("iscat-analysis"),
    }
    try:
        with whole_file(archive) as partial, zipfile.ZipFile(partial, "w") as packed:
            content = {p.relative_to(folder).as_posix(): p.read_bytes() for p in files}
            sums = "".join(
                f"{hashlib.sha256(data).hexdigest()}  {name}\n" for name, data in content.items()
            )
            content["SHA256SUMS"] = sums.encode()
            content[".zenodo.json"] = (json.dumps(about, indent=1) + "\n").encode()
            for name, data in content.items():
                entry = zipfile.ZipInfo(f"{folder.resolve().name}/{name}", _EPOCH)
                entry.compress_type = zipfile.ZIP_DEFLATED
                entry.external_attr = 0o644 << 16
                packed.writestr(entry, data)
    except OSError as error:
        raise DataError(f"{archive}: cannot be written ({error.strerror})") from None
