"""Challenges: movies and stacks whose truth is kept in a file of its own.

The manifest names every file with its hash, and the hash of the truth, so that results can be shown
to be of these files and to have been made without the truth.  The same preset and seed give the
same bytes: expected counts are rounded before photons are drawn, so that the last digit of a
processor's arithmetic does not change them.
"""

from __future__ import annotations

import copy
import hashlib
import json
import math
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import pandas as pd
import tifffile
from pydantic import BaseModel, ConfigDict, Field

from iscat_analysis.bounds import paper
from iscat_analysis.config import LARGEST_NM, Config, config_to_toml, parse_config, refuse_sphere
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.files import sha256_of_files, whole_file
from iscat_analysis.reading import first_line, is_file, model_of, read_text, toml_of
from iscat_analysis.records import PARAMETERS, FloatArray, Progress, silent
from iscat_analysis.report import atomic_folder, check_output
from iscat_analysis.study import Setting, make_setting, trial_generator, write_stack

MANIFEST, TRUTH = "manifest.json", "truth.json"
FORMAT = "iscat-challenge"

KNOWN = frozenset({MANIFEST, TRUTH, "stacks", "movies", "config"})
"""Everything a challenge's folder holds."""

STEPS_PER_ELECTRON = 1024
"""Expected counts are rounded to this part of a photoelectron."""


_Hash = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
_Name = Annotated[str, Field(pattern=r"^\w{1,100}$")]
_File = Annotated[str, Field(pattern=r"^(stacks|movies|config)/\w[\w.]{0,100}$")]
_Text = Annotated[str, Field(max_length=1000)]
_Frame = Annotated[int, Field(ge=0, le=10_000_000)]
_Place = Annotated[float, Field(ge=-LARGEST_NM, le=LARGEST_NM)]


class _About(BaseModel):
    """What a manifest says of a part; the other keys follow from its configuration."""

    model_config = ConfigDict(extra="allow")

    kind: Literal["stacks", "movie"]
    mode: Literal["mass", "localize", "joint"]
    about: _Text


class _Manifest(BaseModel):
    """The form of a manifest."""

    format: Literal["iscat-challenge"]
    version: Literal[1]
    name: _Text
    blind: bool
    made_by: _Text
    files: dict[_File, _Hash]
    truth_sha256: _Hash
    parts: Annotated[dict[_Name, _About], Field(min_length=1)]


class _Event(BaseModel):
    """The form of a particle in a truth."""

    part: _Name
    file: _File
    event: int
    frame: _Frame
    leave: _Frame | None
    x_nm: _Place
    y_nm: _Place
    z_nm: _Place
    mass_kda: Annotated[float, Field(gt=0, le=1e12)]


class _Truth(BaseModel):
    """The form of a truth."""

    format: Literal["iscat-challenge"]
    version: Literal[1]
    seed: int
    parts: dict[_Name, Annotated[dict[Literal["config"], str], Field(min_length=1)]]
    events: list[_Event]


M = TypeVar("M", bound=BaseModel)


@dataclass(frozen=True)
class Challenge:
    """A challenge that was read; its files and its truth are those of its manifest."""

    folder: Path
    manifest: dict[str, Any]
    truth: dict[str, Any]

    def told(self, part: str) -> Config:
        """Give what participants know of a part."""
        path = self.folder / "config" / f"{part}.toml"
        return _config_in(path, str(path))

    def true(self, part: str) -> Config:
        """Give how a part was made."""
        return _config_in(self.truth["parts"][part]["config"], f"{TRUTH}: parts.{part}.config")

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
    if blind and beside.exists():
        if not overwrite:
            raise DataError(f"{beside}: exists already; move it, or pass `overwrite`")
        _read(_Truth, beside, "is to be replaced", "it is no truth of ours: move it")
    with atomic_folder(out, overwrite, known=KNOWN) as building:
        (building / "config").mkdir()
        events: list[dict[str, Any]] = []
        described: dict[str, Any] = {}
        for number, part in enumerate(parts):
            progress("challenge", number, len(parts))
            told = config_to_toml(part.told, comments=False, sections=TOLD)
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
        text = _as_json(truth)
        files = sorted(p for p in building.rglob("*") if p.suffix in (".tif", ".toml"))
        manifest = {
            "format": FORMAT,
            "version": VERSION,
            "name": name,
            "blind": blind,
            "made_by": f"iscat-analysis {version('iscat-analysis')}",
            "files": {p.relative_to(building).as_posix(): sha256_of_files([p]) for p in files},
            "truth_sha256": hashlib.sha256(text).hexdigest(),
            "parts": described,
        }
        with whole_file(beside if blind else building / TRUTH) as partial:
            partial.write_bytes(text)
        (building / MANIFEST).write_bytes(_as_json(manifest))
    return manifest


def _as_json(values: Mapping[str, Any]) -> bytes:
    return f"{json.dumps(values, indent=1, ensure_ascii=False)}\n".encode()


def truth_beside(folder: Path) -> Path:
    """Say where the truth of a blind challenge is kept."""
    return folder.resolve().with_name(f"{folder.resolve().name}.truth.json")


def read_challenge(folder: Path, truth: Path | None = None) -> Challenge:
    """Read a challenge with its truth, and refuse one whose files are not those of its manifest."""
    manifest = _read(_Manifest, folder / MANIFEST, "is no challenge").model_dump()
    for name, expected in manifest["files"].items():
        path = folder / name
        if not is_file(path):
            raise DataError(f"{path}: is missing, and the manifest names it; copy the whole folder")
        if sha256_of_files([path]) != expected:
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
    if sha256_of_files([where]) != manifest["truth_sha256"]:
        raise DataError(
            f"{where}: is not the truth of this challenge (its SHA-256 is not the manifest's)"
        )
    challenge = Challenge(folder, manifest, _read(_Truth, where, "is no truth").model_dump())
    _refuse_contradictions(challenge, where)
    return challenge


def _refuse_contradictions(challenge: Challenge, truth: Path) -> None:
    """Refuse a manifest that is not of the truth's configurations and particles."""
    if (parts := challenge.manifest["parts"]).keys() != challenge.truth["parts"].keys():
        raise DataError(f"{truth}: parts: are not those of the manifest; {_AGAIN}")
    for number, event in enumerate(challenge.truth["events"]):
        if event["file"] not in challenge.manifest["files"]:
            raise DataError(f"{truth}: events.{number}.file: is not in the manifest; {_AGAIN}")
    for name, about in parts.items():
        made, told = challenge.true(name), challenge.told(name)
        known = told.model_copy(update={"bounds": made.bounds, "simulation": made.simulation})
        events = challenge.events(name)
        part = Part(name, about["kind"], made, known, about=about["about"])
        for key, value in _described(part, events).items():
            if about.get(key) != value:
                raise DataError(
                    f"{challenge.folder / MANIFEST}: parts.{name}.{key}: is not {value!r}, as its "
                    f"configuration and its truth have it; {_AGAIN}"
                )
        frames = about.get("frames", about.get("n_before", 0) + 1)
        for number, event in enumerate(events):
            late = event["frame"] >= frames, (event["leave"] or math.inf) <= event["frame"]
            if event["event"] != number or any(late):
                key = "event" if not any(late) else "frame"
                raise DataError(
                    f"{truth}: {name}, particle {number}: {key}: is impossible; {_AGAIN}"
                )
        if not events:
            raise DataError(f"{truth}: events: has none of part {name}; {_AGAIN}")


def manifest_sha256(folder: Path) -> str:
    """Hash the manifest, by which a score says what it is of."""
    return sha256_of_files([folder / MANIFEST])


def draw_stack(setting: Setting, truth: FloatArray, random: np.random.Generator) -> Any:
    """Draw the counts of one stack, frames before and frames after, in camera units.

    Shapes: `truth` (4,), result (t, y, x).
    """
    at, camera = setting.config.bounds, setting.config.camera.assumed
    expected = np.full(
        (at.n_before + at.n_after, setting.pixels, setting.pixels), setting.level_e()
    )
    expected[at.n_before :] += setting.signal_e(truth)
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
        truth[2] = random.uniform(*part.z_nm) if part.z_nm is not None else truth[2]
        truth[3] *= np.exp(random.uniform(low, high))
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
    events = []
    for k, row in enumerate(table.to_dict("records")):
        leave = int(row["leave"]) if pd.notna(row["leave"]) and row["leave"] else None
        truth = np.array([row[name] for name in PARAMETERS], dtype=float)
        events.append(_event(part.name, f"movies/{path.name}", k, int(row["frame"]), leave, truth))
    return events


def _event(
    part: str, file: str, event: int, frame: int, leave: int | None, truth: FloatArray
) -> dict[str, Any]:
    values = {name: float(v) for name, v in zip(PARAMETERS, truth, strict=True)}
    return {"part": part, "file": file, "event": event, "frame": frame, "leave": leave, **values}


def _described(part: Part, events: Sequence[dict[str, Any]]) -> dict[str, Any]:
    told = part.told
    about: dict[str, Any] = {
        "kind": part.kind,
        "mode": told.fit.mode,
        "about": part.about,
        "config": f"config/{part.name}.toml",
        "pixel_size_nm": told.camera.pixel_size_nm,
    }
    if part.kind == "movie":
        return about | {"frames": told.simulation.frames, "shape": list(told.simulation.shape)}
    names = ("n_before", "n_after", "photons_per_pixel")
    return about | {"stacks": len(events), **{name: getattr(told.bounds, name) for name in names}}


_AGAIN = "get the challenge again, or make it with this program"


def _read(model: type[M], path: Path, what: str, remedy: str = _AGAIN) -> M:
    """Read a document of a challenge."""
    try:
        return model_of(model, read_text(path))
    except OSError as error:
        raise DataError(f"{path.parent}: {what} ({path.name}: {error.strerror})") from None
    except ValueError as error:
        raise DataError(f"{path}: {first_line(error)}; {remedy}") from None


def _config_in(text: str | Path, where: str) -> Config:
    """Read a configuration of a challenge."""
    try:
        found = parse_config(toml_of(read_text(text) if isinstance(text, Path) else text))
        refuse_sphere(found, "challenges are of dipoles")
    except (OSError, ValueError, ConfigError) as error:
        raise DataError(f"{where}: {first_line(error)}; {_AGAIN}") from None
    return found


VERSION = 1
"""Raised whenever a preset's bytes change; results of different versions are not compared."""

TOLD = ("optics", "camera", "particle", "calibration", "background", "detection", "fit")
"""Sections of the configuration that participants get."""


@dataclass(frozen=True)
class Part:
    """One kind of file in a challenge.

    ``stacks`` hold one particle each, within a pixel of their middle; ``movie`` is one landing
    movie.  `config` is how they are made, `told` what participants get.
    """

    name: str
    kind: Literal["stacks", "movie"]
    config: Config
    told: Config
    count: int = 1
    z_nm: tuple[float, float] | None = None
    mass_factor: tuple[float, float] = (1.0, 1.0)
    about: str = ""


Values = dict[str, dict[str, Any]]

_PLAIN: Values = {
    "optics": {"wavelength_nm": 525.0, "na": 1.42, "focus_nm": -300.0, "scheme": "iscat"},
    "camera": {
        "pixel_size_nm": 84.4, "frame_rate_hz": 200.0, "exposure_ms": 5.0, "gain_e_per_adu": 1.0,
        "offset_adu": 0.0, "read_noise_e": 0.0,
    },
    "particle": {"kind": "protein", "mass_kda": 1500.0, "height_nm": 5.0},
    "calibration": {"gradient_per_kda": -3.1e-5},
    "fit": {"mode": "mass", "roi_nm": 2700.0, "z_range_nm": [0.0, 500.0]},
    "bounds": {"photons_per_pixel": 1e4, "n_before": 10, "n_after": 10, "pixels": 33},
}  # fmt: skip

_LANDING: Values = {
    "particle": {"mass_kda": 300.0},
    "bounds": {"n_before": 100, "n_after": 100},
    "background": {"method": "sliding"},
    "simulation": {
        "shape": [96, 96], "frames": 800, "photons_per_pixel": 1e4, "background": "speckle",
        "power_noise": 0.002, "count": 12, "species": [150.0, 300.0, 600.0],
    },
}  # fmt: skip

_HAZARDS: Values = {
    "optics": {"focus_nm": -330.0, "aberrations_nm": {"z5": 8.0, "z11": -10.0}},
    "particle": {"height_sd_nm": 4.0, "height_nm": 12.0},
    "simulation": {
        "drift_px_per_frame": [0.001, -0.0005],
        "species": [90.0, 180.0, 360.0],
        "leavings": 3,
        "power_noise": 0.005,
    },
}
"""What is true of the hard preset, and not told."""

_GLASS_NOISE: Values = {
    "camera": {"gain_e_per_adu": 0.45, "offset_adu": 100.0, "read_noise_e": 2.0}
}

_PROTEIN: dict[str, Any] = {"kind": "protein", "mass_kda": 6e4}
"""So heavy that the paper's scattering amplitude gives a thousand photons in ten frames."""

ABOUT = {
    "easy": "one protein on the glass in each stack, a known microscope, shot noise alone",
    "realistic": "landing movies of three species over a speckled background, a known microscope",
    "hard": "landing movies under a microscope that is not what it is said to be, with drift",
    "dong2021": "the set-ups of Dong et al. (2021): gold and protein; iSCAT, COBRI, dark field",
}


def preset_parts(name: str) -> list[Part]:
    """Give the parts of a preset."""
    if name == "easy":
        config = _config(_PLAIN)
        return [Part("easy", "stacks", config, config, 100, mass_factor=(0.5, 2.0))]
    if name == "realistic":
        config = _config(_PLAIN, _LANDING)
        return [Part(f"realistic_{k}", "movie", config, config) for k in (1, 2)]
    if name == "hard":
        told = _config(_PLAIN, _LANDING, _GLASS_NOISE)
        true = _config(_PLAIN, _LANDING, _GLASS_NOISE, _HAZARDS)
        return [Part(f"hard_{k}", "movie", true, told) for k in (1, 2)]
    if name == "dong2021":
        return [_of_the_paper(scheme, kind) for kind in ("gold", "protein") for scheme in _SCHEMES]
    raise ConfigError(f"preset {name!r}: there are {', '.join(ABOUT)}")


_SCHEMES: Mapping[str, tuple[float, float, dict[str, Any]]] = {
    "iscat": (1.0, 3e4, {}),
    "cobri": (paper.COBRI_ATTENUATION, 3e4, {}),
    "darkfield": (1.0, 3e3, {"photons_per_frame": 3e3}),
}
"""Attenuation, photons per pixel and frame, and what else is told of the particle."""


def _of_the_paper(scheme: str, kind: str) -> Part:
    attenuation, photons, further = _SCHEMES[scheme]
    optics = {**paper.OPTICS, "scheme": scheme, "attenuation": attenuation, "focus_nm": 300.0}
    material = paper.PARTICLE if kind == "gold" else _PROTEIN
    plain = {name: keys for name, keys in _PLAIN.items() if name not in ("particle", "calibration")}
    own: Values = {
        "optics": optics,
        "camera": {"pixel_size_nm": 60.0, "samples_per_pixel": 1},
        "particle": {"height_nm": 100.0, **material, **further},
        "fit": {"mode": "joint", "z_range_nm": [0.0, 250.0]},
        "bounds": {"photons_per_pixel": photons, "n_before": 0, "pixels": 45},
    }
    config, about = _config(plain, own), f"{kind}, {scheme}"
    return Part(f"{kind}_{scheme}", "stacks", config, config, 40, (90.0, 110.0), (0.9, 1.1), about)


def parts_of_config(config: Config, count: int) -> list[Part]:
    """Make a challenge of a configuration: stacks of ``[bounds]``, a movie of ``[simulation]``."""
    mode = "joint" if config.fit.follows_tracks else config.fit.mode
    config = config.model_copy(update={"fit": config.fit.model_copy(update={"mode": mode})})
    parts = [Part("stack", "stacks", config, config, count, mass_factor=(0.5, 2.0))]
    if config.simulation.events or config.simulation.count:
        parts.append(Part("movie", "movie", config, config))
    return parts


def _config(*layers: Values) -> Config:
    merged: Values = {}
    for layer in layers:
        for section, keys in layer.items():
            merged[section] = {**merged.get(section, {}), **keys}
    return parse_config(copy.deepcopy(merged))
