"""Small files of every kind that is read, as the instruments and programs write them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import imagecodecs
import numpy as np
import tifffile
from numpy.typing import NDArray
from tiff_files import movie, write_micro_manager

ZSTANDARD, LZ4, BLOSC = 32015, 32004, 32001
_ENCODERS = {
    ZSTANDARD: imagecodecs.zstd_encode,
    LZ4: imagecodecs.lz4h5_encode,
    BLOSC: imagecodecs.blosc_encode,
}
CALIBRATION = (-6.1e-05, 3.7e-04)
"""Contrast per kDa and contrast at zero mass."""

EVENTS: dict[str, NDArray[Any]] = {
    "frame_indices": np.array([6.0, 9.0, 10.0, 250.0]),
    "x_coords": np.array([67.1, 87.2, 73.9, 29.3]),
    "y_coords": np.array([23.2, 6.4, 24.5, 18.4]),
    "contrasts": np.array([0.00295, -0.0284, -0.0039, -0.0036]),
}


def masses() -> NDArray[Any]:
    """Masses of `EVENTS`, worked out branch by branch."""
    slope, offset = CALIBRATION
    return np.array(
        [(c - offset) / slope if c < 0 else -(-c - offset) / slope for c in EVENTS["contrasts"]]
    )


def write_one_mp(
    path: Path, frames: NDArray[Any], *, instrument: str | None = None, **options: Any
) -> Path:
    """Write an uncompressed OneMP movie."""
    with h5py.File(path, "w") as file:
        file.create_dataset("frame", data=frames, **options)
        camera = file.create_group("configuration/Devices/AcqCam")
        camera["Height"], camera["Width"] = frames.shape[1:]
        camera["FrameRate"], camera["ExposureTime"] = 1000.0, 0.95
        engine = file.create_group("configuration/Engines/AcqMovieEngine")
        engine["FrameBinning"], engine["PixelBinning"] = 5, 4
        if instrument is not None:
            file["device_info/InstrumentName"] = instrument
    return path


def write_two_mp(
    path: Path,
    frames: NDArray[Any],
    *,
    differences: bool = False,
    encoding: str | None = None,
    keyframes: bool | int = True,
    old_names: bool = False,
    instrument: str | None = None,
    filter_number: int | None = None,
    **options: Any,
) -> Path:
    """Write a movie of format 3, plain or as differences."""
    stored = frames
    if differences:
        stored = frames.copy()
        stored[1:] = np.diff(frames, axis=0)  # unsigned: wraps around, as the instrument does
    with h5py.File(path, "w") as file:
        file["format_version_number"] = 3
        if filter_number is None:
            dataset = file.create_dataset("movie/frame", data=stored, **options)
        else:
            dataset = _by_hand(file.create_group("movie"), stored, filter_number)
        if encoding is not None:
            dataset.attrs["encoding"] = encoding
        if keyframes is True:
            file["movie/keyframe"] = frames[[0, -1]]
        elif keyframes:  # one every so many frames, as .mpr files have them
            file["movie/keyframe"] = frames[::keyframes]
            file["movie/keyframe"].attrs["indices"] = np.arange(0, len(frames), keyframes)
        if old_names:
            camera = file.create_group("movie/configuration/Devices/AcqCam")
            camera["Height"], camera["Width"] = frames.shape[1:]
            names = ("FrameRate", "SoftwareFrameBinning", "SoftwarePixelBinning", "ExposureTime")
        else:
            camera = file.create_group("movie/configuration/acq_camera")
            names = ("frame_rate", "frame_binning", "pixel_binning", "exposure_time")
        for name, value in zip(names, (500.0, 2, 6, 1.9), strict=True):
            camera[name] = value
        if instrument is not None:
            file["movie/device_info/InstrumentName"] = instrument
    return path


def _by_hand(group: h5py.Group, stored: NDArray[Any], filter_number: int) -> h5py.Dataset:
    """Store chunks of one frame through a filter that libhdf5 has no plugin for."""
    settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    settings.set_chunk((1, *stored.shape[1:]))
    settings.set_filter(filter_number, h5py.h5z.FLAG_OPTIONAL, ())
    space = h5py.h5s.create_simple(stored.shape)
    identity = h5py.h5d.create(
        group.id, b"frame", h5py.h5t.py_create(stored.dtype), space, settings
    )
    for number, frame in enumerate(stored):
        raw = bytes(_ENCODERS[filter_number](frame.tobytes()))
        identity.write_direct_chunk((number, 0, 0), raw)
    return h5py.Dataset(identity)


def write_events(path: Path, dialect: str) -> Path:
    """Write an event table: ``"2021"``, ``"2024"``, ``"mpr"``, ``"one movie"`` or ``"csv"``."""
    slope, offset = CALIBRATION
    if dialect == "csv":
        names = [*EVENTS, "masses_kDa", "nearest_neighbour_distances"]
        columns = [*EVENTS.values(), masses(), np.full(4, np.finfo(float).max)]
        rows = [",".join(repr(float(c[row])) for c in columns) for row in range(4)]
        notes = ["# program 2.4.2", "# made, by hand", "#", "# 4 events"]
        path.write_text("\n".join([",".join(names), *rows, *notes]) + "\n", encoding="utf-8")
        return path
    prefix = {"mpr": "analysis/events/events_fitted/", "one movie": "per_movie_events/0/"}
    group = prefix.get(dialect, "")
    with h5py.File(path, "w") as file:
        for name, values in EVENTS.items():
            file[group + name] = values
        if dialect == "2021":
            file["masses_kDa"] = masses()
            file["mass_model/c_1kDa"], file["mass_model/o_0kDa"] = slope, offset
            file["mass_model/contrasts"] = slope * np.array([66.0, 480.0]) + offset
            file["mass_model/masses"] = [66, 480]
            file["app_info/version"] = "2.4.2"
        else:
            stored = masses() if dialect == "2024" else np.full(4, np.nan)
            file[f"{group}calibrated_values"] = stored
            file[f"{group}calibration/gradient"] = slope
            file[f"{group}calibration/offset"] = offset
    return path


def samples(folder: Path) -> dict[str, list[bytes]]:
    """Make the bytes of every kind of file: ``tiff``, ``map``, ``mp``, ``h5`` and ``csv``."""
    frames = movie(5, 12, 14)
    smooth = np.cumsum(np.ones_like(movie(9, 12, 14)), axis=0, dtype="u2") * 9000
    found: dict[str, list[bytes]] = {"tiff": [], "map": [], "mp": [], "h5": [], "csv": []}

    def take(kind: str, path: Path) -> None:
        found[kind].append(path.read_bytes())

    path = folder / "sample"
    for options in (
        {},
        {"bigtiff": True},
        {"byteorder": ">"},
        {"ome": True, "metadata": {"axes": "TYX", "PhysicalSizeX": 0.08, "PhysicalSizeY": 0.08}},
        {"imagej": True, "metadata": {"axes": "TYX", "unit": "um", "finterval": 0.01}},
        {"compression": "zlib", "rowsperstrip": 4},
        {"compression": "lzw", "predictor": True},
        {"compression": "zstd", "tile": (16, 16)},
        {"compression": "packbits"},
        {"compression": "lzma", "bigtiff": True},
    ):
        tifffile.imwrite(path, frames, **options)
        take("tiff", path)
    stamps = [{"PixelSizeUm": 0.1, "Exposure-ms": 5, "ElapsedTime-ms": 10 * t} for t in range(5)]
    take("tiff", write_micro_manager(path, frames, stamps))
    for options in ({}, {"compression": "zlib"}, {"ome": True}):
        tifffile.imwrite(path, frames[0].astype("f4"), **options)
        take("map", path)
    take("mp", write_one_mp(path, frames))
    take("mp", write_one_mp(path, frames, chunks=(2, 5, 14), compression="gzip", shuffle=True))
    take("mp", write_one_mp(path, frames, chunks=(1, 12, 14), compression="lzf"))
    take("mp", write_two_mp(path, frames, instrument="Refeyn TwoMP"))
    encoded = {"differences": True, "encoding": "TIME_DIFFERENCE"}
    for number in (ZSTANDARD, LZ4, BLOSC):
        take("mp", write_two_mp(path, smooth, filter_number=number, **encoded))
    take("mp", write_two_mp(path, smooth, differences=True, keyframes=4, old_names=True))
    for dialect in ("2021", "2024", "mpr", "one movie"):
        take("h5", write_events(path, dialect))
    take("csv", write_events(path, "csv"))
    path.unlink()
    return found
