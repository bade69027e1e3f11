"""Days whose movies are parts of files, folders, or sets of files."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
import zarr
from small_movies import SETUP, simulate
from tiff_files import write_ome_set

import iscat_analysis as ia
from iscat_analysis.config import configure
from iscat_analysis.day.jobs import saw, seen, sha256_of
from iscat_analysis.day.table import Table, make_plan, read_table
from iscat_analysis.errors import ConfigError
from iscat_analysis.movie import open_stack

COUNTS = np.arange(7 * 6 * 5, dtype="u2").reshape(7, 6, 5)


def _table(folder: Path, *paths: str) -> Table:
    rows = "".join(f'"{path}"\n' for path in paths)
    (folder / "samples.csv").write_text(f"path\n{rows}")
    return read_table(folder / "samples.csv")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with a movie of every kind that has parts."""
    with h5py.File(tmp_path / "day.h5", "w") as file:
        file["run 1/movie"] = COUNTS
        file["run 2/movie"] = COUNTS + 1
    zarr.save(str(tmp_path / "movie.zarr"), COUNTS)
    (tmp_path / "set").mkdir()
    write_ome_set(tmp_path / "set", COUNTS)
    (tmp_path / "plain.bin").write_bytes(COUNTS.tobytes())
    return tmp_path


ADDRESSES = (
    "day.h5::/run 1/movie", "day.h5::/run 2/movie", "movie.zarr", "set/m_0.ome.tif",
    "plain.bin::6x5,uint16",
)  # fmt: skip


def test_a_table_takes_addresses(folder: Path) -> None:
    table = _table(folder, *ADDRESSES)
    samples = ["day.run 1.movie", "day.run 2.movie", "movie", "m_0.ome", "plain"]
    assert [row.sample for row in table.rows] == samples
    for row in table.rows:
        with open_stack(row.path) as stack:
            assert stack.shape == COUNTS.shape
    names = {movie.name for movie in make_plan(table, configure()).movies}
    assert names == {"day.run 1.movie", "day.run 2.movie", "movie", "set/m_0.ome", "plain"}


@pytest.mark.parametrize(
    ("paths", "said"),
    [
        (["absent.h5::/movie"], "absent.h5::/movie: there is no such file"),
        (["set"], "set: is a folder, and one movie is wanted"),
        (["day.h5::/run 1/movie", "day.h5::run 1/movie"], "is the movie of line 2 already"),
        (["set/m_0.ome.tif", "set/m_1.ome.tif"], "is the movie of line 2 already"),
    ],
)
def test_addresses_that_are_wrong_are_told_by_row(
    folder: Path, paths: list[str], said: str
) -> None:
    with pytest.raises(ConfigError) as told:
        _table(folder, *paths)
    assert said in str(told.value)


def test_a_folder_takes_every_kind_once(folder: Path) -> None:
    for path in (folder / "set").iterdir():
        path.rename(folder / path.name)
    shutil.copy(folder / "day.h5", folder / "many.h5")
    with h5py.File(folder / "one.hdf5", "w") as file:
        file["movie"] = COUNTS
    (folder / "damaged.h5").write_bytes((folder / "one.hdf5").read_bytes()[:600])
    np.save(folder / "array.npy", COUNTS)
    (folder / "more").mkdir()
    np.save(folder / "more" / "array.npy", COUNTS)
    rows = read_table(folder).rows
    assert [row.given for row in rows] == [
        "array.npy", "damaged.h5", "m_0.ome.tif", "movie.zarr", "one.hdf5",
    ]  # fmt: skip


def test_a_copy_of_a_file_is_a_movie_of_its_own_whatever_it_says_of_its_name(folder: Path) -> None:
    named = '<OME xmlns="x"><Image><Pixels SizeT="2"><TiffData><UUID FileName="a.ome.tif"/>'
    named += "</TiffData></Pixels></Image></OME>"
    for name in "ab":
        tifffile.imwrite(folder / f"{name}.ome.tif", COUNTS, description=named, metadata=None)
    assert len(_table(folder, "a.ome.tif", "b.ome.tif").rows) == 2


@pytest.mark.parametrize(
    ("address", "changed"),
    [
        ("movie.zarr", "movie.zarr"),
        ("set/m_0.ome.tif", "set/m_2.ome.tif"),
        ("set/m_1.ome.tif", "set/m_0.ome.tif"),
        ("day.h5::/run 1/movie", "day.h5"),
    ],
)
def test_a_movie_is_recognised_by_all_of_its_files(
    folder: Path, address: str, changed: str
) -> None:
    path = folder / address
    record = {"fingerprint": seen(path), "sha256": sha256_of(path)}
    with open_stack(path) as stack:
        assert record["fingerprint"] == stack.identity
        assert record["sha256"] == stack.sha256()
    assert saw(record, path)
    file = folder / changed
    file = sorted(p for p in file.rglob("*") if p.is_file())[-1] if file.is_dir() else file
    os.utime(file, ns=(1, 1))
    assert seen(path) != record["fingerprint"]
    assert saw(record, path)  # copied: the bytes are the same
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    assert not saw(record, path)


def test_parts_of_a_file_are_told_apart(folder: Path) -> None:
    first, second = (folder / f"day.h5::/run {k}/movie" for k in (1, 2))
    assert seen(first) != seen(second)
    assert sha256_of(first) != sha256_of(second)


def test_a_set_that_is_completed_has_changed(folder: Path) -> None:
    path = folder / "set" / "m_0.ome.tif"
    (folder / "set" / "m_1.ome.tif").rename(folder / "away")
    before = seen(path)
    assert before
    (folder / "away").rename(folder / "set" / "m_1.ome.tif")
    assert seen(path) != before


def test_a_day_of_addresses_is_analysed_and_then_left_alone(tmp_path: Path) -> None:
    simulate(tmp_path / "movie.tif", seed=1)
    counts = tifffile.imread(tmp_path / "movie.tif")
    with h5py.File(tmp_path / "day.h5", "w") as file:
        file["run 1/movie"] = counts
    zarr.save(str(tmp_path / "movie.zarr"), counts)
    _table(tmp_path, "day.h5::/run 1/movie", "movie.zarr")

    def run() -> ia.Batch:
        return ia.batch(tmp_path / "samples.csv", out=tmp_path / "out", config=SETUP)

    first = run()
    assert first.analysed == ("day.run 1.movie", "movie")
    assert first.movies["events"].tolist() == [2, 2]
    assert run().analysed == ()
    zarr.open(str(tmp_path / "movie.zarr"), mode="r+")[-1, 0, 0] = 0
    assert run().analysed == ("movie",)
