"""Frames that a file stores in chunks of its own are decoded once, whoever asks for them."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import zarr

from iscat_analysis.camera import Camera
from iscat_analysis.movie import open_stack
from iscat_analysis.movie import stack as slabs_module
from iscat_analysis.movie.hdf5 import StoredArray
from iscat_analysis.movie.ome_zarr import CheckedStore
from iscat_analysis.search import chunks as chunks_module
from iscat_analysis.search.chunks import Reader

SHAPE = (210, 40, 48)
SPANS = [(0, 90), (50, 140), (100, 190), (150, 210)]
"""Chunks of a movie with halos: each begins before the last one ends."""


@pytest.fixture(autouse=True)
def _small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read four frames at a time, as of a large field."""
    monkeypatch.setattr(chunks_module, "_PIECE_BYTES", 4 * 2 * SHAPE[1] * SHAPE[2])


@pytest.fixture(scope="module")
def counts() -> np.ndarray:
    """Draw frames of light."""
    return np.random.default_rng(4).poisson(900, SHAPE).astype("u2")


def _read_through(path: Path, counts: np.ndarray) -> None:
    """Read a movie as an analysis does: span after span, in pieces, in two threads."""
    with open_stack(path) as movie, ThreadPoolExecutor(2) as pool:
        reader = Reader(movie, Camera(), 0, SHAPE[0], room_bytes=10**9)
        for span in SPANS:
            chunk = reader.chunk(span, 10, pool)
            found = chunk.counts.array(0, len(chunk.counts))
            np.testing.assert_array_equal(found, counts[slice(*span)])
            assert chunk.good.all()


@pytest.mark.parametrize(
    "layout",
    [
        {"chunks": (8, 16, 16), "shards": (32, 48, 48)},
        {"chunks": (50, 40, 48)},
        {"chunks": (7, 20, 48)},
    ],
    ids=["shards", "deep", "odd"],
)
def test_a_zarr_movie_is_read_once(
    layout: dict[str, Any], counts: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "movie.zarr"
    zarr.create_array(path, data=counts, zarr_format=3, **layout)
    files = [f for f in path.rglob("*") if f.is_file() and f.name != "zarr.json"]
    stored = sum(file.stat().st_size for file in files)
    read: list[int] = []
    real = CheckedStore.get

    async def counting(self: CheckedStore, key: str, *args: Any, **options: Any) -> Any:
        found = await real(self, key, *args, **options)
        if "/" in key and found is not None:
            read.append(len(found))
        return found

    monkeypatch.setattr(CheckedStore, "get", counting)
    _read_through(path, counts)
    assert sum(read) == pytest.approx(stored, rel=0.02)  # the index of a shard is read as well
    read.clear()
    monkeypatch.setattr(slabs_module, "_KEPT_BYTES", 0)  # control
    _read_through(path, counts)
    assert sum(read) > 1.2 * stored


@pytest.mark.parametrize("chunk", [(64, 16, 16), (9, 40, 48)], ids=["deep", "odd"])
def test_an_hdf5_movie_is_decoded_once(
    chunk: tuple[int, ...], counts: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "movie.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("frames", data=counts, chunks=chunk, compression="gzip")
    decoded: list[int] = []
    real = StoredArray._decode
    monkeypatch.setattr(
        StoredArray, "_decode", lambda self, number: decoded.append(number) or real(self, number)
    )
    _read_through(path, counts)
    assert sorted(decoded) == list(range(len(set(decoded))))
    assert len(decoded) == np.prod([-(-n // c) for n, c in zip(SHAPE, chunk, strict=True)])
    decoded.clear()
    monkeypatch.setattr(slabs_module, "_KEPT_BYTES", 0)  # control
    _read_through(path, counts)
    assert len(decoded) > 1.2 * len(set(decoded))


def test_a_slab_that_cannot_be_read_is_asked_for_again() -> None:
    calls: list[tuple[int, int]] = []

    def read(start: int, stop: int) -> np.ndarray:
        calls.append((start, stop))
        if len(calls) == 1:
            raise OSError("away for a moment")
        return np.arange(start, stop)[:, None]

    kept = slabs_module.in_slabs(read, (10, 1), np.dtype(np.int64), 4)
    with pytest.raises(OSError, match="away"):
        kept(0, 3)
    assert kept(0, 10).ravel().tolist() == list(range(10))
    assert kept(5, 7).ravel().tolist() == [5, 6]
    assert calls == [(0, 4), (0, 4), (4, 8), (8, 10)]
