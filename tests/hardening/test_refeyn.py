"""Refeyn movies and event tables, of every generation, give back what was put in."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import h5py
import numpy as np
import pytest
from hardening.samples import (
    BLOSC,
    CALIBRATION,
    EVENTS,
    LZ4,
    ZSTANDARD,
    masses,
    write_events,
    write_one_mp,
    write_two_mp,
)
from numpy.typing import NDArray
from tiff_files import movie

import iscat_analysis as ia
from iscat_analysis.answers.calibrations import read_contrasts
from iscat_analysis.errors import DataError
from iscat_analysis.movie import hdf5 as refeyn_module
from iscat_analysis.movie import open_stack
from iscat_analysis.movie.tables import TABLE_COLUMNS, read_events

ENCODED = {"differences": True, "encoding": "TIME_DIFFERENCE"}


def wrapping(frames: int = 40, dtype: str = "u2") -> NDArray:
    """Make a movie whose differences wrap around in both directions."""
    rng = np.random.default_rng(1)
    return rng.integers(0, np.iinfo(dtype).max, (frames, 12, 14), dtype, endpoint=True)


def assert_same(path: Path, expected: NDArray) -> None:
    with open_stack(path) as stack:
        assert stack.shape == expected.shape
        assert stack.dtype == expected.dtype
        np.testing.assert_array_equal(stack.read(5, 9), expected[5:9])
        np.testing.assert_array_equal(stack.read(0, len(expected)), expected)
        np.testing.assert_array_equal(stack.read(7, 8), expected[7:8])
        assert stack.read(3, 3).shape == (0, *expected.shape[1:])


# ---- movies --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"chunks": (1, 12, 14)},
        {"chunks": (7, 5, 14), "compression": "gzip", "shuffle": True},
        {"chunks": (3, 12, 5), "compression": "lzf"},
        {"chunks": (40, 12, 14), "compression": "gzip"},
    ],
)
@pytest.mark.parametrize("dtype", ["u1", "u2", ">u2", "i4", "f4"])
def test_one_mp(tmp_path: Path, dtype: str, options: dict) -> None:
    frames = movie(40, 12, 14, dtype)
    path = write_one_mp(tmp_path / "m.mp", frames, **options)
    assert_same(path, frames.astype(np.dtype(dtype).newbyteorder("=")))


@pytest.mark.parametrize("dtype", ["u1", "u2", "u4"])
@pytest.mark.parametrize("filter_number", [None, ZSTANDARD, LZ4, BLOSC])
def test_two_mp_as_differences(tmp_path: Path, dtype: str, filter_number: int | None) -> None:
    frames = wrapping(dtype=dtype)
    path = write_two_mp(tmp_path / "m.mp", frames, filter_number=filter_number, **ENCODED)
    assert_same(path, frames)


def test_plain_and_differences_are_told_apart_without_a_word(tmp_path: Path) -> None:
    frames = wrapping()
    for differences in (True, False):
        path = write_two_mp(tmp_path / "m.mp", frames, differences=differences)
        assert_same(path, frames)
    path = write_two_mp(tmp_path / "m.mp", frames, keyframes=False)
    assert_same(path, frames)


@pytest.mark.parametrize("every", [7, 39, 100])
@pytest.mark.parametrize("encoded", [ENCODED, {}])
def test_keyframes_every_so_often(tmp_path: Path, every: int, encoded: dict) -> None:
    frames = wrapping()
    assert_same(write_two_mp(tmp_path / "m.mp", frames, keyframes=every, **encoded), frames)


def test_a_wrong_sum_is_refused(tmp_path: Path) -> None:
    path = write_two_mp(tmp_path / "m.mp", wrapping(), **ENCODED)
    with h5py.File(path, "r+") as file:
        file["movie/frame"][3, 2, 1] += 1
    with pytest.raises(DataError, match="do not add up"):
        open_stack(path)


def test_an_unknown_encoding_is_refused(tmp_path: Path) -> None:
    frames = wrapping()
    path = write_two_mp(tmp_path / "m.mp", frames, encoding="SOMETHING")
    with h5py.File(path, "r+") as file:
        file["movie/frame"][:] = frames[::-1] // 3
    with pytest.raises(DataError, match="do not add up"):
        open_stack(path)


def test_without_keyframes_the_attribute_decides(tmp_path: Path) -> None:
    path = write_two_mp(tmp_path / "m.mp", wrapping(), keyframes=False, **ENCODED)
    assert_same(path, wrapping())


@pytest.mark.parametrize("version", ["earliest", "latest"])
@pytest.mark.parametrize("text", ["Refeyn TwoMP", b"Refeyn TwoMP"])
def test_names_of_either_kind_of_text(tmp_path: Path, text: str | bytes, version: str) -> None:
    path = write_two_mp(tmp_path / "m.mp", movie(), old_names=True)
    with h5py.File(path, "r+", libver=version) as file:
        for number in range(40):  # the heap holds more than one text
            file[f"movie/notes/{number}"] = "x" * number
        kind = np.bytes_ if isinstance(text, bytes) else str
        file["movie/device_info/InstrumentName"] = kind(text)
    with open_stack(path) as stack:
        assert stack.metadata.pixel_size_nm == pytest.approx(11.8 * 6)


def test_differences_are_summed_once_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = wrapping(200)
    path = write_two_mp(tmp_path / "m.mp", frames, **ENCODED)
    monkeypatch.setattr(refeyn_module, "ANCHOR_BYTES", 10 * frames[0].nbytes)
    read: list[int] = []
    original = refeyn_module.StoredArray.read

    def counted(self: object, start: int, stop: int) -> NDArray:
        read.append(stop - start)
        return original(self, start, stop)  # type: ignore[arg-type]

    with open_stack(path) as stack:
        monkeypatch.setattr(refeyn_module.StoredArray, "read", counted)
        for number in range(200):
            np.testing.assert_array_equal(stack.read(number, number + 1)[0], frames[number])
        assert sum(read) == 200
        read.clear()
        np.testing.assert_array_equal(stack.read(133, 134)[0], frames[133])
        assert sum(read) <= 20  # from the nearest of ten remembered frames


def test_threads_share_a_movie(tmp_path: Path) -> None:
    frames = wrapping(120)
    path = write_two_mp(tmp_path / "m.mp", frames, **ENCODED)
    order = np.random.default_rng(2).permutation(120)
    with open_stack(path) as stack, ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda n: stack.read(int(n), int(n) + 1)[0], order))
    np.testing.assert_array_equal(found, frames[order])


def test_metadata_of_both_instruments(tmp_path: Path) -> None:
    with open_stack(write_one_mp(tmp_path / "m.mp", movie())) as stack:
        metadata, notes = stack.metadata, stack.notes
    assert metadata.source == "refeyn"
    assert metadata.pixel_size_nm == pytest.approx(19.3 * 4)
    assert metadata.frame_rate_hz == pytest.approx(1000 / 5)
    assert metadata.exposure_ms == pytest.approx(0.95 * 5)
    assert notes[0].endswith("every Refeyn OneMP is 19.3 nm times the pixel binning of 4: 77.2 nm")
    with open_stack(write_two_mp(tmp_path / "m.mp", movie())) as stack:
        assert stack.metadata.pixel_size_nm == pytest.approx(11.8 * 6)
        assert stack.metadata.frame_rate_hz == pytest.approx(250)
        assert stack.metadata.exposure_ms == pytest.approx(3.8)
        assert "Refeyn TwoMP" in stack.notes[0]


@pytest.mark.parametrize(
    ("instrument", "pixel"), [(None, None), ("Refeyn OneMP", 19.3 * 6), ("Another", None)]
)
def test_the_instrument_decides_where_it_is_named(
    tmp_path: Path, instrument: str | None, pixel: float | None
) -> None:
    path = write_two_mp(tmp_path / "m.mp", movie(), old_names=True, instrument=instrument)
    with open_stack(path) as stack:
        assert stack.metadata.pixel_size_nm == (None if pixel is None else pytest.approx(pixel))
        assert bool(stack.notes) == (pixel is not None)
        assert stack.metadata.frame_rate_hz == pytest.approx(250)


@pytest.mark.parametrize("shape", [(1, 12, 14), (12, 14), (2, 3, 12, 14), (0, 12, 14)])
def test_what_is_no_movie_is_refused(tmp_path: Path, shape: tuple[int, ...]) -> None:
    path = tmp_path / "m.mp"
    with h5py.File(path, "w") as file:
        file["frame"] = np.zeros(shape, "u2")
    with pytest.raises(DataError, match=r"single frame|has the shape"):
        open_stack(path)


def test_an_event_table_is_no_movie(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no Refeyn movie"):
        open_stack(write_events(tmp_path / "events.h5", "2021"))
    with pytest.raises(DataError, match="without an event table"):
        read_events(write_one_mp(tmp_path / "m.mp", movie()))


# ---- event tables --------------------------------------------------------------------------------


@pytest.mark.parametrize("dialect", ["2021", "2024", "mpr", "one movie", "csv"])
def test_every_dialect_of_events(tmp_path: Path, dialect: str) -> None:
    table = read_events(write_events(tmp_path / "events", dialect))
    assert tuple(table.columns) == TABLE_COLUMNS
    assert table["frame"].dtype == np.int64
    for column, name in zip(TABLE_COLUMNS, EVENTS, strict=False):
        np.testing.assert_array_equal(table[column], EVENTS[name])
    np.testing.assert_allclose(table["mass_kda"], masses(), rtol=1e-14)


def test_missing_values_are_nan(tmp_path: Path) -> None:
    path = tmp_path / "events.csv"
    path.write_text(
        "contrasts,frame_indices,x_coords,y_coords,calibrated_values\n"
        f"-0.1,3,1,2,{np.finfo(float).max}\n-0.2,4,,nan,7\n\n# a\n# b\n"
    )
    table = read_events(path)
    assert table["frame"].tolist() == [3, 4]
    assert table["contrast"].tolist() == [-0.1, -0.2]
    assert np.isnan(table["mass_kda"][0])
    assert table["mass_kda"][1] == 7
    assert table[["x_px", "y_px"]].isna().iloc[1].all()


def test_the_events_of_several_movies_are_together_or_one_by_one(tmp_path: Path) -> None:
    path = write_events(tmp_path / "events.h5", "one movie")
    with h5py.File(path, "r+") as file:
        file.copy("per_movie_events/0", "per_movie_events/b")
        file["per_movie_events/b/contrasts"][...] *= 2
        del file["per_movie_events/b/calibration/offset"]
        file["per_movie_events/b/calibration/offset"] = 0.0
    slope, _ = CALIBRATION
    twice = 2 * EVENTS["contrasts"]
    table = read_events(path)
    assert table["movie"].tolist() == ["0"] * 4 + ["b"] * 4
    np.testing.assert_array_equal(table["contrast"], [*EVENTS["contrasts"], *twice])
    np.testing.assert_allclose(table["mass_kda"], [*masses(), *(twice / slope)], rtol=1e-14)
    assert table["frame"].isna().all()  # each movie counts from 0
    assert "events of 2 movies are taken together" in table.attrs["notes"][0]
    for part, expected in (("b", twice), ("per_movie_events/0", EVENTS["contrasts"])):
        one = read_events(Path(f"{path}::{part}"))
        np.testing.assert_array_equal(one["contrast"], expected)
        assert one["frame"].tolist() == EVENTS["frame_indices"].tolist()
    np.testing.assert_array_equal(read_contrasts(Path(f"{path}::b"))["contrast"], twice)
    (tmp_path / "series.csv").write_text("path,concentration_nm\nevents.h5::b,3\n")
    with pytest.raises(DataError, match=r"events\.h5::b: holds 4 events, too few"):
        ia.fit_kd(tmp_path / "series.csv", model="dimer", masses_kda=[66.0])
    with pytest.raises(DataError, match="holds no movie 'c'; its movies are 0, b"):
        read_events(Path(f"{path}::c"))
    with pytest.raises(DataError, match="holds the events of one movie; leave out ::c"):
        read_events(Path(f"{write_events(tmp_path / 'events.csv', 'csv')}::c"))


def test_columns_of_different_length_are_refused(tmp_path: Path) -> None:
    path = write_events(tmp_path / "events.h5", "2021")
    with h5py.File(path, "r+") as file:
        del file["x_coords"]
        file["x_coords"] = [1.0, 2.0]
    with pytest.raises(DataError, match=r"differ in length .*x_coords 2"):
        read_events(path)


def test_the_measured_table_is_reproduced_to_the_last_bit(data_dir: Path) -> None:
    path = data_dir / "refeyn_events_2.4.2.h5"
    if not path.is_file():
        pytest.skip(f"no measured event table: {path} is absent")
    table = read_events(path)
    assert len(table) == 2069
    assert (table["mass_kda"] < 0).sum() == 641
