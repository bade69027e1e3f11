"""Challenges: movies and stacks whose truth is kept in a file of its own.

The manifest names every file with its hash, and the hash of the truth, so that results can be shown
to be of these files and to have been made without the truth.  The same preset and seed give the
same bytes: expected counts are rounded before photons are drawn, so that the last digit of a
processor's arithmetic does not change them.
"""

from __future__ import annotations

import hashlib
import json
import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from iscat_analysis.config import Config, config_to_toml, parse_config, refuse_sphere
from iscat_analysis.errors import DataError
from iscat_analysis.files import whole_file
from iscat_analysis.reading import is_file, read_bytes, read_json, toml_of
from iscat_analysis.records import PARAMETERS, FloatArray, Progress, silent
from iscat_analysis.report.output import atomic_folder, check_output
from iscat_analysis.study.challenge_presets import TOLD, VERSION, Part
from iscat_analysis.study.setting import Setting, make_setting
from iscat_analysis.study.simulate import write_stack
from iscat_analysis.study.trials import trial_generator

MANIFEST, TRUTH = "manifest.json", "truth.json"
FORMAT = "iscat-challenge"

KNOWN = frozenset({MANIFEST, TRUTH, "stacks", "movies", "config"})
"""Everything a challenge's folder holds."""

STEPS_PER_ELECTRON = 1024
"""Expected counts are rounded to this part of a photoelectron."""

_LARGEST = 2_000_000_000


@dataclass(frozen=True)
class Challenge:
    """A challenge that was read; its files and its truth are those of its manifest."""

    folder: Path
    manifest: dict[str, Any]
    truth: dict[str, Any]

    def told(self, part: str) -> Config:
        """Give what participants know of a part."""
        return _config_of((self.folder / "config" / f"{part}.toml").read_text(encoding="utf-8"))

    def true(self, part: str) -> Config:
        """Give how a part was made."""
        return _config_of(self.truth["parts"][part]["config"])

    def events(self, part: str) -> list[dict[str, Any]]:
        """Give the particles of a part."""
        return [one for one in self.truth["events"] if one["part"] == part]


def make_challenge(
    parts: Sequence[Part],
    out: Path,
    *,
    name: str,
    seed: int | None = None,
    blind: bool = False,
    overwrite: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Write a challenge; its manifest.  Where it is blind the truth lies beside the folder."""
    chosen = secrets.randbits(48) if seed is None and blind else seed if seed is not None else 1
    beside = truth_beside(out)
    check_output(out, overwrite, known=KNOWN)
    if blind and beside.exists() and not overwrite:
        raise DataError(f"{beside}: exists already; move it, or pass `overwrite`")
    with atomic_folder(out, overwrite, known=KNOWN) as building:
        (building / "config").mkdir()
        events: list[dict[str, Any]] = []
        described: dict[str, Any] = {}
        for number, part in enumerate(parts):
            progress("challenge", number, len(parts))
            sections = [section for section in TOLD if getattr(part.told, section) is not None]
            told = config_to_toml(part.told, comments=False, sections=sections)
            (building / "config" / f"{part.name}.toml").write_text(told, encoding="utf-8")
            make = _write_stacks if part.kind == "stacks" else _write_movie
            made = make(part, building, [chosen, number])
            events += made
            described[part.name] = _described(part, made)
        progress("challenge", len(parts), len(parts))
        truth = {
            "format": FORMAT,
            "version": VERSION,
            "seed": chosen,
            "parts": {p.name: {"config": config_to_toml(p.config, comments=False)} for p in parts},
            "events": events,
        }
        text = json.dumps(truth, indent=1, ensure_ascii=False) + "\n"
        files = sorted(p for p in building.rglob("*") if p.is_file() and p.suffix in _HASHED)
        manifest = {
            "format": FORMAT,
            "version": VERSION,
            "name": name,
            "blind": blind,
            "made_by": f"iscat-analysis {version('iscat-analysis')}",
            "files": {p.relative_to(building).as_posix(): _sha256(p) for p in files},
            "truth_sha256": hashlib.sha256(text.encode()).hexdigest(),
            "parts": described,
        }
        where = building / TRUTH
        if blind:
            with whole_file(beside) as partial:
                partial.write_bytes(text.encode())
        else:
            where.write_bytes(text.encode())
        written = json.dumps(manifest, indent=1, ensure_ascii=False) + "\n"
        (building / MANIFEST).write_bytes(written.encode())
    return manifest


_HASHED = (".tif", ".toml")


def truth_beside(folder: Path) -> Path:
    """Say where the truth of a blind challenge is kept."""
    return folder.resolve().with_name(f"{folder.resolve().name}.truth.json")


def read_challenge(folder: Path, truth: Path | None = None) -> Challenge:
    """Read a challenge with its truth, and refuse one whose files are not those of its manifest."""
    manifest = _json(folder / MANIFEST, "is no challenge")
    if manifest.get("format") != FORMAT:
        raise DataError(f"{folder / MANIFEST}: is not the manifest of a challenge")
    if manifest.get("version") != VERSION:
        raise DataError(
            f"{folder}: is of version {manifest.get('version')} and this program scores {VERSION}; "
            "make the challenge again"
        )
    for name, expected in manifest["files"].items():
        path = folder / name
        if not is_file(path):
            raise DataError(f"{path}: is missing, and the manifest names it; copy the whole folder")
        if _sha256(path) != expected:
            raise DataError(
                f"{path}: is not the file of the manifest (its SHA-256 differs); results of it "
                "cannot be scored: get the challenge again"
            )
    inside = folder / TRUTH
    where = truth or (inside if is_file(inside) else truth_beside(folder))
    if not is_file(where):
        raise DataError(
            f"{folder}: is blind and its truth is not here ({where.name}); whoever made it has it: "
            "give it as `truth`"
        )
    if _sha256(where) != manifest["truth_sha256"]:
        raise DataError(
            f"{where}: is not the truth of this challenge (its SHA-256 is not the manifest's)"
        )
    return Challenge(folder, manifest, _json(where, "is no truth"))


def manifest_sha256(folder: Path) -> str:
    """Hash the manifest, by which a score says what it is of."""
    return _sha256(folder / MANIFEST)


def draw_stack(setting: Setting, truth: FloatArray, random: np.random.Generator) -> Any:
    """Draw the counts of one stack, frames before and frames after, in camera units.

    Shapes: `truth` (4,), result (t, y, x).
    """
    at, camera = setting.config.bounds, setting.config.camera.assumed
    empty = np.full((setting.pixels, setting.pixels), setting.level_e())
    frame = empty + setting.signal_e(truth)
    expected = np.concatenate(
        [np.broadcast_to(image, (n, *image.shape)) for image, n in
         ((empty, at.n_before), (frame, at.n_after)) if n]
    )  # fmt: skip
    rounded = np.rint(expected * STEPS_PER_ELECTRON) / STEPS_PER_ELECTRON
    electrons = random.poisson(np.maximum(rounded, 0.0)).astype(float)
    if setting.read_variance_e2:
        electrons += random.normal(0, np.sqrt(setting.read_variance_e2), electrons.shape)
    gain, offset = float(camera.gain_e_per_adu), float(camera.offset_adu)
    counts = np.rint(electrons / gain + offset)
    if counts.max() > np.iinfo(np.uint16).max:
        raise DataError(
            f"bounds.photons_per_pixel = {at.photons_per_pixel:g} does not fit into 16 bits: lower "
            "it, or raise camera.gain_e_per_adu"
        )
    return np.maximum(counts, 0).astype(np.uint16)


def _write_stacks(part: Part, folder: Path, seed: Sequence[int]) -> list[dict[str, Any]]:
    refuse_sphere(part.config, "challenges are of dipoles")
    setting = make_setting(part.config, part.config.fit.mode)
    (folder / "stacks").mkdir(exist_ok=True)
    pixel, centre = setting.context.pixel_nm, setting.truth
    low, high = np.log(part.mass_factor)
    events = []
    for i in range(part.count):
        random = trial_generator(seed[0], 2000 + seed[1], i)
        truth = centre.copy()
        truth[:2] += random.uniform(-1, 1, 2) * pixel
        height = random.uniform(*part.z_nm) if part.z_nm is not None else truth[2]
        factor = float(np.exp(random.uniform(low, high)))
        truth[2], truth[3] = height, truth[3] * factor
        truth = np.round(truth, 6)
        counts = draw_stack(setting, truth, random)
        name = f"stacks/{part.name}_{i:04d}.tif"
        tifffile.imwrite(
            folder / name, counts, photometric="minisblack", metadata=None, software=FORMAT
        )
        events.append(_event(part.name, name, i, setting.config.bounds.n_before, None, truth))
    return events


def _write_movie(part: Part, folder: Path, seed: Sequence[int]) -> list[dict[str, Any]]:
    (folder / "movies").mkdir(exist_ok=True)
    path = folder / "movies" / f"{part.name}.tif"
    number = int(np.random.SeedSequence(list(seed)).generate_state(1)[0])
    table = write_stack(part.config, path, seed=number)
    path.with_suffix(".truth.csv").unlink()
    return [
        _event(
            part.name, f"movies/{path.name}", k, int(row["frame"]),
            int(row["leave"]) if row["leave"] == row["leave"] and row["leave"] else None,
            np.array([row[name] for name in PARAMETERS], dtype=float),
        )
        for k, row in enumerate(table.astype(object).where(table.notna(), 0).to_dict("records"))
    ]  # fmt: skip


def _event(
    part: str, file: str, event: int, frame: int, leave: int | None, truth: FloatArray
) -> dict[str, Any]:
    values = {name: float(v) for name, v in zip(PARAMETERS, truth, strict=True)}
    return {"part": part, "file": file, "event": event, "frame": frame, "leave": leave, **values}


def _described(part: Part, events: Sequence[dict[str, Any]]) -> dict[str, Any]:
    at, stacks = part.told.bounds, part.kind == "stacks"
    out: dict[str, Any] = {
        "kind": part.kind,
        "mode": part.told.fit.mode,
        "about": part.about,
        "config": f"config/{part.name}.toml",
        "pixel_size_nm": part.told.camera.pixel_size_nm,
    }
    if stacks:
        out |= {
            "stacks": len(events),
            "n_before": at.n_before,
            "n_after": at.n_after,
            "photons_per_pixel": at.photons_per_pixel,
        }
    else:
        rows, columns = part.told.simulation.shape
        out |= {"frames": part.told.simulation.frames, "shape": [rows, columns]}
    return out


def _config_of(text: str) -> Config:
    return parse_config(toml_of(text))


def _json(path: Path, what: str) -> dict[str, Any]:
    try:
        found = read_json(path)
    except OSError as error:
        raise DataError(f"{path.parent}: {what} ({path.name}: {error.strerror})") from None
    except ValueError:
        raise DataError(f"{path}: is damaged; get the challenge again") from None
    if not isinstance(found, dict):
        raise DataError(f"{path}: is damaged; get the challenge again")
    return found


def _sha256(path: Path) -> str:
    try:
        return hashlib.sha256(read_bytes(path, _LARGEST)).hexdigest()
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None
