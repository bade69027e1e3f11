"""What the fuzzer damages, and what reads it: small valid files of every kind that is read.

A seed is a dictionary of files by their paths; the first one is what a reader is given, or the
folder that holds it where the seed is a folder.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import scipy.io
import tifffile
import zarr
from hardening.samples import samples
from microscopes import configuration
from tiff_files import movie, write_stk

from iscat_analysis import find_species, fit_kd, open_result
from iscat_analysis.answers.calibrations import read_contrasts
from iscat_analysis.camera import read_map
from iscat_analysis.config import Config, config_to_toml, load_config
from iscat_analysis.day.table import read_table
from iscat_analysis.errors import DataError
from iscat_analysis.executors import open_executor
from iscat_analysis.files import sha256_of_files
from iscat_analysis.fitting.run import packed
from iscat_analysis.movie import open_stack
from iscat_analysis.movie.tables import read_events
from iscat_analysis.optics.waves import Template
from iscat_analysis.reading import read_json, read_parquet
from iscat_analysis.records import Clip, EventView
from iscat_contest.challenge import MANIFEST, TRUTH, make_challenge, parts_of_config, read_challenge
from iscat_contest.process import Answer, read_answers

Seed = dict[str, bytes]
Reader = Callable[[Path], Any]

_FRAMES = movie(6, 12, 14)
_FOLDER = "frames"


def seeds(folder: Path) -> dict[str, list[Seed]]:
    """Make valid files of every kind."""
    found = {kind: [{"input": data} for data in files] for kind, files in samples(folder).items()}
    found["npy"] = [{"input": _npy(a)} for a in (_FRAMES, _FRAMES.astype(">u2"), _FRAMES.T.T)]
    found["npy"].append({"input": _npy(np.asfortranarray(_FRAMES.astype("f4")))})
    found["zarr"] = [_zarr(folder / f"{k}.zarr", **options) for k, options in enumerate(_LAYOUTS)]
    found["dataset"] = [_dataset(folder / "sample", **options) for options in _DATASETS]
    found["set"] = [_ome_set()]
    found["tiff"].append({"input": write_stk(folder / "m", _FRAMES, um_per_px=0.08).read_bytes()})
    found["npy"] += [
        {"input": _saved(save, movie=array, times=np.arange(3.0))}
        for save in (np.savez, np.savez_compressed)
        for array in (_FRAMES, np.asfortranarray(_FRAMES.astype("f4")))
    ]
    found["dataset"] += [{"input": _mat(packed)} for packed in (False, True)]
    found["dataset"] += [{"input": _mat_hdf5(folder / "m", **options)} for options in _DATASETS]
    found["set"].append(_frame_files())
    settings = "save/frame/shape\t(12, 14)\nsave/frame/dtype\t<u2\nsave/saved\t6\n"
    raw = _FRAMES.astype("<u2").tobytes()
    found["raw"] = [{"movie.bin": raw, "movie_settings.dat": settings.encode()}]
    found["toml"] = [{"input": text.encode()} for text in _configurations()]
    found["table"] = [*_tables()]
    found["samples"] = [{"input": text.encode()} for text in _SAMPLES]
    found["movies"] = [{name: text.encode(), "a.tif": b"II*\0"} for name, text in _MOVIES.items()]
    found["contrasts"] = [{"input": _fits().to_csv(index=False).encode()}]
    found["result"] = [_result()]
    found["cache"] = [_cache()]
    template = Template(np.eye(9), np.eye(9), 40.0, 84.4, 160.0, 0.1, 5)
    found["template"] = [{"input": template.to_bytes()}]
    found["address"] = [{"input": b'{"type": "Scheduler", "address": "nowhere", "workers": {}}'}]
    found["challenge"] = [_challenge(folder / "challenge")]
    found["answers"] = [{"input": f"{_ANSWER.line()}\n".encode() * 2}]
    return found


_ANSWER = Answer({"x_nm": np.array([1.0, np.nan, 3.0, 4.0])}, {"no number": 1}, 0.5, 0.4, 90.0)


def _challenge(out: Path) -> Seed:
    config = configuration(fit={"mode": "mass", "roi_nm": 700.0}, bounds={"pixels": 9})
    make_challenge(parts_of_config(config, 2), out, name="small")
    files = sorted(path for path in out.rglob("*") if path.is_file() and path.name[0] != ".")
    files.sort(key=lambda path: path.name != MANIFEST)
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in files}


def _saved(save: Callable[..., Any], *given: Any, **more: Any) -> bytes:
    """Give what a function writes into a file."""
    out = io.BytesIO()
    save(out, *given, **more)
    return out.getvalue()


def _npy(array: np.ndarray[Any, Any]) -> bytes:
    return _saved(np.save, array)


def _mat(packed: bool) -> bytes:
    held = {"movie": _FRAMES.transpose(1, 2, 0), "setup": {"a": 1}, "text": "of Monday"}
    return _saved(scipy.io.savemat, held, do_compression=packed)


def _mat_hdf5(path: Path, **options: Any) -> bytes:
    with h5py.File(path, "w", userblock_size=512) as file:
        file.create_dataset("movie", data=_FRAMES, **options)
    return b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM" + path.read_bytes()[128:]


def _frame_files() -> Seed:
    files = {}
    for number, frame in enumerate(_FRAMES):
        content = _saved(tifffile.imwrite, frame, compression="zlib" if number % 2 else None)
        files[f"{_FOLDER}/frame{number}.tif"] = content
    return files


_LAYOUTS: tuple[dict[str, Any], ...] = (
    {"zarr_format": 2, "chunks": (3, 12, 14)},
    {"zarr_format": 3, "chunks": (2, 6, 14)},
    {"zarr_format": 3, "chunks": (1, 6, 7), "shards": (3, 12, 14)},
    {"zarr_format": 3, "chunks": (6, 12, 14), "compressors": None},
)


def _zarr(folder: Path, **options: Any) -> Seed:
    stored = zarr.create_array(folder, shape=_FRAMES.shape, dtype="u2", **options)
    stored[:] = _FRAMES
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {f"m.zarr/{path.relative_to(folder)}": path.read_bytes() for path in files}


_DATASETS: tuple[dict[str, Any], ...] = (
    {}, {"chunks": (2, 5, 14), "compression": "gzip"}, {"chunks": (1, 12, 14), "shuffle": True},
)  # fmt: skip


def _dataset(path: Path, **options: Any) -> Seed:
    with h5py.File(path, "w") as file:
        file.create_dataset("run 3/movie", data=_FRAMES, **options)
        file["run 3/note"] = "of Monday"
    content = path.read_bytes()
    path.unlink()
    return {"input": content}


def _ome_set() -> Seed:
    block = '<TiffData FirstT="{}" IFD="{}"><UUID FileName="{}">urn:uuid:{}</UUID></TiffData>'
    names = ("a.ome.tif", "b.ome.tif")
    blocks = "".join(block.format(t, t % 3, names[t // 3], t // 3) for t in range(6))
    text = (
        '<?xml version="1.0"?><OME><Image ID="Image:0"><Pixels DimensionOrder="XYZCT" SizeT="6" '
        f'SizeC="1" SizeZ="1" SizeX="14" SizeY="12" Type="uint16">{blocks}</Pixels></Image></OME>'
    )
    how = {"description": text, "metadata": None, "photometric": "minisblack"}
    parts = zip(names, (_FRAMES[:3], _FRAMES[3:]), strict=True)
    return {name: _saved(tifffile.imwrite, part, **how) for name, part in parts}


def _configurations() -> list[str]:
    simulation = {"pixel_size_nm": 84.4, "gain_e_per_adu": 2.0}
    return [
        config_to_toml(Config(camera=simulation)),
        config_to_toml(Config(), comments=False),
        "[simulation]\nframes = 20\n[[simulation.events]]\nframe = 3\nx_px = 5.0\ny_px = 6.0\n"
        "[[simulation.movers]]\nd_um2_s = 1.5\n[particle]\nkind = 'gold'\ndiameter_nm = 20\n",
    ]


def _events() -> pd.DataFrame:
    rng = np.random.default_rng(3)
    mass = rng.normal(np.repeat([66.0, 132.0], 15), 8.0)
    place = rng.uniform(0, 99, (2, mass.size)).round(3)
    return pd.DataFrame(
        {"event": range(mass.size), "frame": np.arange(mass.size) * 7, "x_px": place[0],
         "y_px": place[1], "mass_kda": mass.round(3), "sigma_mass_kda": 8.0,
         "snr": (mass / 8).round(3), "contrast": (-mass * 5e-5).round(7), "status": "ok"}
    )  # fmt: skip


def _fits() -> pd.DataFrame:
    return _events().assign(n_after=50, systematic_mass_kda=1.0, systematic_contrast=1e-5)


def _parquet(table: pd.DataFrame) -> bytes:
    return bytes(table.to_parquet(index=False))


def _tables() -> list[Seed]:
    events = _events()
    simple = events[["mass_kda"]]
    return [
        {"input": events.to_csv(index=False).encode()},
        {"input": simple.to_csv(index=False, sep=";", decimal=",").encode()},
        {"input": _parquet(_fits())},
        {"o.iscat/fits.csv": _fits().to_csv(index=False).encode(),
         "o.iscat/summary.json": b'{"detection_threshold_snr": 5.2}'},
    ]  # fmt: skip


_SAMPLES = (
    "path,concentration_nm,role\na.csv,3,sample\nb.csv,30.5,sample\nc.csv,,blank\n",
    "# of Monday\npath;a_nm;b_nm\na.csv;3,5;10\nb.csv;7;20\n",
)
_MOVIES = {
    "movies.csv": "path,sample,role,concentration_nm,standards\na.tif,PBS,sample,3,\n",
    "movies.toml": "[[movies]]\npath = 'a.tif'\nrole = 'calibrant'\nstandards = [66, 146.5]\n",
}


def _result() -> Seed:
    return {
        "o.iscat/summary.json": b'{"mode": "mass", "events": 30, "movie": "m.tif", "frames": 400}',
        "o.iscat/fits.parquet": _parquet(_fits()),
        "o.iscat/config.toml": config_to_toml(Config()).encode(),
    }


def _cache() -> Seed:
    images = np.arange(36.0).reshape(3, 3, 4)
    view = EventView(3, 1, 2, *images, clip=Clip((5,), 4, images[:1]))
    return {"part.npz": _saved(np.savez, **packed((view, _events())))}


# ---- readers -------------------------------------------------------------------------------------


def _frames(path: Path) -> None:
    with open_stack(path) as stack:
        repr(stack)
        for _ in stack.chunks(memory_mb=16):
            pass


def _zarr_folder(path: Path) -> None:
    while path.suffix != ".zarr":
        path = path.parent
    _frames(path)


def _kept_part(path: Path) -> None:
    from iscat_analysis.fitting.run import Checkpoint

    part = object.__new__(Checkpoint)  # of any key
    part._folder, part.kept = path.parent, 0
    part._path = lambda _: path
    part.load(0)


def _outside(path: Path) -> None:
    with open_executor(scheduler_file=path):
        pass


def _parts(path: Path) -> None:
    """Read what a result is made of, each by itself."""
    for name, read in (("summary.json", read_json), ("fits.parquet", read_parquet)):
        try:
            read(path.with_name(name))
        except (OSError, ValueError) as error:
            if not str(error):
                raise AssertionError("it says nothing") from error
    open_result(path.parent)


def _signed_challenge(path: Path) -> None:
    """Read a challenge whose hashes somebody has made anew."""
    folder = path.parent
    with suppress(OSError, ValueError, TypeError, KeyError, AttributeError):
        manifest = json.loads(path.read_bytes())
        manifest["truth_sha256"] = sha256_of_files([folder / TRUTH])
        names = [name for name in manifest["files"] if (folder / name).is_file()]
        manifest["files"] |= {name: sha256_of_files([folder / name]) for name in names}
        path.write_text(json.dumps(manifest), encoding="utf-8")
    read_challenge(folder)


def _answers(path: Path) -> None:
    if refused := read_answers(path, [4, 4])[1]:
        raise DataError(refused)


READERS: dict[str, Reader] = {
    "tiff": _frames,
    "map": lambda path: read_map(path, "camera.gain_e_per_adu", (12, 14)),
    "mp": _frames,
    "h5": read_events,
    "csv": read_events,
    "npy": _frames,
    "zarr": _zarr_folder,
    "dataset": _frames,
    "set": lambda path: _frames(path.parent if path.parent.name == _FOLDER else path),
    "raw": _frames,
    "toml": load_config,
    "table": lambda path: find_species(
        path.parent if path.parent.suffix == ".iscat" else path, k=1, draws=0
    ),
    "samples": lambda path: fit_kd(path, model="ab", masses_kda=(40, 80)),
    "movies": read_table,
    "contrasts": read_contrasts,
    "result": _parts,
    "cache": _kept_part,
    "template": Template.read,
    "address": _outside,
    "challenge": _signed_challenge,
    "answers": _answers,
}
"""What reads each kind of seed."""

REFUSED_WHOLE = ("samples", "address")
"""Kinds whose seeds lead to a refusal, as the files that they name are not there."""
