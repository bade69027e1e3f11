"""Movies among other arrays, of NumPy and MATLAB; numbers that settings describe; single frames."""

from __future__ import annotations

import os
import struct
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
import tifffile
from small_files import COUNTS, SHAPE, assert_whole, refused

from iscat_analysis.day.table import read_table
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.movie import SUFFIXES, files_of, find_movies, is_movie, open_stack, path_beside

MATLAB = COUNTS.transpose(1, 2, 0)
"""As MATLAB has it: (y, x, t)."""


def write_mat(path: Path, **arrays: Any) -> None:
    """Write version 7.3: HDF5 behind 512 bytes of MATLAB's, its axes the other way round."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, array in arrays.items():
            options = {"chunks": (2, 5, 4), "compression": "gzip"} if name == "packed" else {}
            file.create_dataset(name, data=array.T, **options)
        file["#refs#/a"] = MATLAB.T  # of what a cell refers to
        cell = file.create_dataset("cell", (1, 1), dtype=h5py.ref_dtype)
        cell[0, 0] = file["#refs#/a"].ref
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\0\2IM")


# ---- .npz ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["u1", "<u2", ">u2", "<f4"])
@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_reads_the_only_movie_among_arrays(
    tmp_path: Path, dtype: str, order: str, save: Any
) -> None:
    array = np.asarray(COUNTS % 200, dtype=dtype, order=order)  # type: ignore[call-overload]
    path = tmp_path / "m.npz"
    save(path, movie=array, times=np.arange(7.0))
    assert_whole(path, array)
    assert_whole(f"{path}::movie", array)
    with open_stack(path) as stack:
        assert stack.notes == ("its frames are those of the array movie",)
    save(path, array)
    with open_stack(path) as stack:
        assert not stack.notes


def test_several_movies_are_named_to_choose_from(tmp_path: Path) -> None:
    path = tmp_path / "m.npz"
    np.savez(path, a=COUNTS, b=COUNTS[::-1], dark=COUNTS[0])
    refused(path, "holds 2 arrays of frames (a, b)", 'm.npz::a"')
    assert_whole(f"{path}::b", COUNTS[::-1])
    refused(f"{path}::dark", "dark holds uint16 of shape (6, 5)", "are in: a, b")
    refused(f"{path}::c", "is not there", "are in: a, b")
    with open_stack(f"{path}::a") as a, open_stack(f"{path}::b") as b:
        assert (a.name, path_beside(Path(f"{path}::a"), "").name) == ("m.npz::a", "m.a")
        assert a.identity != b.identity
    np.savez(path, COUNTS[0])
    refused(path, "arr_0 holds uint16 of shape (6, 5)", "are in: none")


class Trap:
    """What runs when it is unpickled."""

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.mkdir, ("sprung",)


def test_objects_are_never_unpickled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    trap = np.empty(SHAPE, dtype=object)
    trap[:] = Trap()
    np.savez("m.npz", movie=trap, other=COUNTS)
    refused("m.npz::movie", "holds Python objects, which are not read")
    assert_whole("m.npz")
    np.save("m.npy", trap)
    refused("m.npy", "object")
    assert not Path("sprung").exists()
    np.load("m.npy", allow_pickle=True)
    assert Path("sprung").exists()  # the trap is set


def test_archives_of_other_things_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "m.npz"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("a.tif", b"II*\0")
    refused(path, "is a ZIP archive without arrays of NumPy; unpack it")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        header = b"\x93NUMPY\x01\x00\x76\0{'descr':'<u2','fortran_order':False,'shape':(%d,%d,%d)}"
        file.writestr("a.npy", (header % (10**5, 10**4, 10**4)).ljust(127) + b"\n" + bytes(99))
    refused(path, "would grow from", "which no recording does")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("a.npy", b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**25) + bytes(2**25))
    tracemalloc.start()
    refused(path, "is damaged")
    assert tracemalloc.get_traced_memory()[1] < 2**22
    tracemalloc.stop()
    path.write_bytes(b"PK\x03\x04" + bytes(90))
    refused(path, "begins like a ZIP archive but is damaged")


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_archives_that_are_cut_short_are_refused_at_every_length(tmp_path: Path, save: Any) -> None:
    path = tmp_path / "m.npz"
    save(path, movie=COUNTS)
    whole = path.read_bytes()
    for size in range(4, len(whole), 17):
        path.write_bytes(whole[:size])
        refused(path, "m.npz")


# ---- MATLAB --------------------------------------------------------------------------------------


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("dtype", ["u1", "u2", "i4", "f4", "f8"])
def test_reads_matlab_with_time_as_its_last_axis(tmp_path: Path, dtype: str, packed: bool) -> None:
    array = (MATLAB % 200).astype(dtype)
    path = tmp_path / "m.mat"
    held = {"movie": array, "pixel": 84.4, "text": "of Monday", "setup": {"a": 1}}
    scipy.io.savemat(path, held, do_compression=packed)
    assert_whole(path, array.transpose(2, 0, 1))
    assert_whole(f"{path}::movie", array.transpose(2, 0, 1))
    with open_stack(path) as stack:
        assert "array movie" in stack.notes[0]
    scipy.io.savemat(path, {"m": array[:, :, None]}, do_compression=packed)  # (y, x, 1, t)
    assert_whole(path, array.transpose(2, 0, 1))


def test_reads_matlab_of_the_other_byte_order(tmp_path: Path) -> None:
    """As MATLAB on a big-endian machine writes it, name and flags in short elements."""
    data = MATLAB.astype(">u2").tobytes(order="F").ljust(424, b"\0")
    shape = np.array([5, 12, 6, 5, 7, 0], ">u4").tobytes()  # type, bytes, sizes, padding
    flags = np.array([6, 8, 11, 0], ">u4").tobytes()
    name = b"\0\1\0\1m\0\0\0"  # one byte of type 1, in the list itself
    numbers = np.array([4, COUNTS.nbytes], ">u4").tobytes() + data
    matrix = flags + shape + name + numbers
    head = b"MATLAB 5.0 MAT-file".ljust(124) + b"\1\0MI"
    (tmp_path / "m.mat").write_bytes(head + np.array([14, len(matrix)], ">u4").tobytes() + matrix)
    assert np.array_equal(scipy.io.loadmat(tmp_path / "m.mat")["m"], MATLAB)
    assert_whole(tmp_path / "m.mat")


def test_reads_matlab_that_is_hdf5(tmp_path: Path) -> None:
    path = tmp_path / "m.mat"
    write_mat(path, packed=MATLAB)
    assert_whole(path)
    write_mat(path, packed=MATLAB, movie=MATLAB[:, :, ::-1], times=np.arange(7.0)[None])
    refused(path, "holds 2 datasets of frames (/movie, /packed)")
    assert_whole(f"{path}::packed")
    assert_whole(f"{path}::/movie", COUNTS[::-1])
    refused(f"{path}::/cell", "not an array of integers or floats")
    assert not find_movies(tmp_path)
    write_mat(path, movie=MATLAB)
    assert find_movies(tmp_path) == [path]


def test_what_matlab_keeps_beside_numbers_is_named(tmp_path: Path) -> None:
    path = tmp_path / "m.mat"
    cell = np.empty((1, 2), dtype=object)
    cell[0, 0], cell[0, 1] = MATLAB, "a"
    held = {"c": cell, "s": {"movie": MATLAB}, "z": MATLAB.astype(complex), "flat": MATLAB[..., 0]}
    scipy.io.savemat(path, held)
    refused(path, "c is a cell array; s is a struct; z is complex; flat has the shape 6 x 5")
    refused(f"{path}::s", "s is a struct", "are in: none")
    scipy.io.savemat(path, {**held, "a": MATLAB, "b": MATLAB[:, :, ::-1]})
    refused(path, "holds 2 arrays of frames (a, b)", 'm.mat::a"')
    assert_whole(f"{path}::b", COUNTS[::-1])
    scipy.io.savemat(path, {}, appendmat=False)
    refused(path, "holds no array")


@pytest.mark.parametrize("packed", [False, True])
def test_matlab_that_is_cut_short_is_refused_at_every_length(tmp_path: Path, packed: bool) -> None:
    path = tmp_path / "m.mat"
    scipy.io.savemat(path, {"movie": MATLAB}, do_compression=packed)
    whole = path.read_bytes()
    for size in range(20, len(whole), 17):
        path.write_bytes(whole[:size])
        refused(path, "m.mat")


def test_matlab_that_would_grow_without_measure_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "m.mat"
    scipy.io.savemat(path, {"movie": MATLAB})
    raw = bytearray(path.read_bytes())
    at = raw.index(np.array([6, 5, 7], "<i4").tobytes())
    raw[at : at + 12] = np.array([60_000, 50_000, 7], "<i4").tobytes()
    path.write_bytes(raw)
    refused(path, "is truncated (420 of 42000000000 bytes are there)")


# ---- a folder of frames --------------------------------------------------------------------------


def write_frames(
    folder: Path, name: str = "frame{}.tif", counts: np.ndarray = COUNTS, **options: Any
) -> Path:
    folder.mkdir(exist_ok=True)
    for number, frame in enumerate(counts):
        tifffile.imwrite(folder / name.format(number), frame, photometric="minisblack", **options)
    return folder


LONG = np.concatenate([COUNTS, COUNTS[::-1]])


@pytest.mark.parametrize(
    "options",
    [{}, {"compression": "zlib"}, {"byteorder": ">"}, {"metadata": None, "rowsperstrip": 2}],
    ids=["plain", "packed", "big endian", "strips"],
)
@pytest.mark.parametrize("name", ["frame{}.tif", "img_{:05}_c0_2.TIFF", "{}.tif"])
def test_reads_a_folder_of_frames_in_natural_order(
    tmp_path: Path, name: str, options: dict[str, Any]
) -> None:
    folder = write_frames(tmp_path / "run 3.5 nM", name, LONG, **options)
    (folder / ".hidden.tif").write_bytes(b"")
    (folder / "notes.txt").write_text("of Monday")
    assert_whole(folder, LONG)
    assert find_movies(tmp_path) == [folder]
    assert is_movie(folder)
    assert path_beside(folder, ".iscat").name == "run 3.5 nM.iscat"
    assert len(read_table(tmp_path).rows) == 1
    with open_stack(folder) as stack:
        assert files_of(folder) == tuple(folder / name.format(k) for k in range(14))
        before = stack.sha256(), stack.identity
    with (folder / name.format(3)).open("ab") as file:
        file.write(b"0")
    with open_stack(folder) as stack:
        assert stack.sha256() != before[0]
        assert stack.identity != before[1]


def test_headers_that_differ_are_read_one_by_one(tmp_path: Path) -> None:
    folder = write_frames(tmp_path / "a")
    for number, frame in enumerate(COUNTS[3:5]):
        text = "another one" * number
        tifffile.imwrite(folder / f"frame{number + 3}.tif", frame, software=text, metadata=None)
    tifffile.imwrite(folder / "frame5.tif", COUNTS[5], compression="zlib")
    assert_whole(folder)


def test_the_text_of_micro_manager_in_the_folder_is_read(tmp_path: Path) -> None:
    folder = write_frames(tmp_path / "a", "img_{:09}_Default_000.tif")
    (folder / "metadata.txt").write_text('{"Summary": {"Interval_ms": 5, "PixelSizeUm": 0.0844}}')
    with open_stack(folder) as stack:
        assert stack.metadata.pixel_size_nm == pytest.approx(84.4)
        assert stack.metadata.frame_rate_hz == pytest.approx(200)


def test_folders_that_lack_frames_or_hold_others_are_refused(tmp_path: Path) -> None:
    folder = write_frames(tmp_path / "a", counts=LONG)
    (folder / "frame4.tif").unlink()
    refused(folder, "1 are missing (4)", "copy the folder again")
    tifffile.imwrite(folder / "frame4.tif", COUNTS[:2], photometric="minisblack")
    refused(folder, "frame4.tif: holds 2 frames, but the other files")
    tifffile.imwrite(folder / "frame4.tif", COUNTS[0, :4])
    refused(folder, "frame4.tif: has other pixels than frame0.tif")
    (folder / "frame4.tif").write_bytes((folder / "frame3.tif").read_bytes()[:-9])
    refused(folder, "frame4.tif: is truncated")
    (folder / "frame4.tif").unlink()
    (folder / "dark.tif").write_bytes((folder / "frame3.tif").read_bytes())
    refused(folder, "different kinds of names (dark.tif, frame#.tif)")
    assert not find_movies(tmp_path)
    channels = tmp_path / "b"
    for channel in "01":
        write_frames(channels, f"img_c{channel}_t{{:03}}.tif")
    refused(channels, "count 2 x 7 frames by several numbers")
    every = tmp_path / "c"
    write_frames(every)
    for number in reversed(range(7)):
        (every / f"frame{number}.tif").rename(every / f"frame{5 * number}.tif")
    assert_whole(every)


def test_a_file_that_shrinks_while_the_folder_is_open(tmp_path: Path) -> None:
    folder = write_frames(tmp_path / "a")
    with open_stack(folder) as stack:
        (folder / "frame2.tif").write_bytes(b"II*\0")
        with pytest.raises(DataError, match=r"frame2\.tif: became shorter"):
            stack.read(0, 7)
        (folder / "frame2.tif").unlink()
        with pytest.raises(DataError, match=r"frame2\.tif: can no longer be read"):
            stack.read(0, 7)


def test_a_folder_of_frames_is_no_day(tmp_path: Path) -> None:
    folder = write_frames(tmp_path / "a", counts=LONG)
    with pytest.raises(ConfigError, match="is one movie, with a frame in each file"):
        read_table(folder)
    few = write_frames(tmp_path / "b")  # found by those who name it, and not in a search
    assert find_movies(tmp_path) == [folder]
    assert_whole(few)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no such pipes")
def test_pipes_are_not_waited_for(tmp_path: Path) -> None:
    for suffix in (".npz", ".mat", ".stk", ".nd2", ".czi"):
        os.mkfifo(tmp_path / f"m{suffix}")
        refused(tmp_path / f"m{suffix}", "is a pipe or a device")
    folder = write_frames(tmp_path / "a", counts=LONG)
    os.mkfifo(folder / "frame99.tif")
    assert find_movies(tmp_path) == [folder]
    assert_whole(folder, LONG)


def test_every_format_is_found_in_a_folder() -> None:
    assert {".tif", ".stk", ".npy", ".npz", ".mat", ".mp", ".h5", ".nd2", ".czi", ".zarr"} <= {
        *SUFFIXES
    }


# ---- numbers that settings beside them, or their name, describe ---------------------------------

# As `pylablib.core.fileio.savefile.save_dict` writes what cam-control's frame saver hands it.
SETTINGS = """\
cam/data_dimensions\t(6, 5)
cam/frame_timings\t(1.000000000000E-03, 2.000000000000E-03)
save/path\tD:/data/movie.bin
save/path_kind\tpfx
save/append\t{append}
save/format\traw
save/saved\t{saved}
save/frame/shape\t{shape}
save/frame/dtype\t{dtype}

# Saved on 2026/01/23 10:11:12
"""


def _settings(path: Path, **changes: object) -> None:
    given = {"append": False, "saved": 7, "shape": "(6, 5)", "dtype": "<u2", **changes}
    path.write_text(SETTINGS.format(**given), encoding="utf-8")


@pytest.mark.parametrize("suffix", [".bin", ".raw"])
@pytest.mark.parametrize("dtype", ["<u2", "|u1", "<f8"])
def test_reads_a_movie_with_its_settings(tmp_path: Path, dtype: str, suffix: str) -> None:
    counts = (COUNTS % 200).astype(dtype)
    path = tmp_path / f"movie{suffix}"
    path.write_bytes(counts.tobytes())
    _settings(tmp_path / "movie_settings.dat", dtype=dtype)
    assert_whole(path, counts)
    with open_stack(path) as stack:
        assert stack.shape == COUNTS.shape
        assert stack.read(2, 4).tolist() == counts[2:4].tolist()
        before = stack.identity
    _settings(tmp_path / "movie_settings.dat", dtype=dtype, shape="(5, 6)")
    with open_stack(path) as stack:
        assert stack.shape == (7, 5, 6)
        assert stack.identity != before


def test_settings_in_a_folder_of_the_recording(tmp_path: Path) -> None:
    (tmp_path / "frames.bin").write_bytes(COUNTS.tobytes())
    _settings(tmp_path / "settings.dat")
    assert_whole(tmp_path / "frames.bin")


def test_what_is_said_on_the_command_line_wins(tmp_path: Path) -> None:
    path = tmp_path / "movie.bin"
    path.write_bytes(COUNTS.tobytes())
    _settings(tmp_path / "movie_settings.dat")
    with open_stack(f"{path}::15x7,uint16") as stack:
        assert stack.shape == (2, 15, 7)


@pytest.mark.parametrize("stem", ["movie", "frames", "a[1]_20260123"])
def test_reads_a_movie_in_parts_from_any_of_them(tmp_path: Path, stem: str) -> None:
    for number, part in enumerate((COUNTS[:3], COUNTS[3:6], COUNTS[6:])):
        (tmp_path / f"{stem}_{number:04}.bin").write_bytes(part.tobytes())
    (tmp_path / f"{stem}_background.bin").write_bytes(COUNTS[0].tobytes())
    (tmp_path / f"{stem}_more_0000.bin").write_bytes(COUNTS[0].tobytes())
    settings = tmp_path / ("settings.dat" if stem == "frames" else f"{stem}_settings.dat")
    _settings(settings, append=True)
    hashes = set()
    for number in range(3):
        path = tmp_path / f"{stem}_{number:04}.bin"
        assert_whole(path)
        with open_stack(path) as stack:
            hashes.add(stack.sha256())
        assert len(files_of(path)) == 4
    assert len(hashes) == 1
    assert [row.given for row in read_table(tmp_path).rows] == [f"{stem}_0000.bin"]
    (tmp_path / f"{stem}_0001.bin").rename(tmp_path / "away.bin")
    refused(tmp_path / f"{stem}_0000.bin", "part 0001 of its movie is missing")
    (tmp_path / "away.bin").rename(tmp_path / f"{stem}_0001.bin")
    (tmp_path / f"{stem}_0002.bin").unlink()
    refused(tmp_path / f"{stem}_0000.bin", "7 frames were saved, but there are 6")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"shape": "(6, 4)"}, "420 bytes, but movie_settings.dat says 6 x 4 pixels of uint16"),
        ({"dtype": "<u4", "shape": "(6, 10)"}, "multiple of 240"),
        ({"saved": 6}, "6 frames were saved, but there are 7"),
        ({"saved": 8, "append": True}, "8 frames were saved, but there are 7"),
        ({"dtype": "<u17"}, "is no type of numbers"),
        ({"dtype": "?", "saved": 14}, "needs to be frames"),
        ({"shape": "(0, 5)"}, "multiple of 0"),
        ({"shape": "(7, 6, 5)"}, "does not say save/frame/shape"),
        ({"dtype": ""}, "written when a recording ends"),
    ],
)
def test_settings_that_do_not_fit_arerefused(
    tmp_path: Path, changes: dict[str, object], said: str
) -> None:
    (tmp_path / "movie.bin").write_bytes(COUNTS.tobytes())
    _settings(tmp_path / "movie_settings.dat", **changes)
    refused(tmp_path / "movie.bin", said, "movie")


def test_frames_added_to_an_earlier_recording_are_read_with_it(tmp_path: Path) -> None:
    (tmp_path / "movie.bin").write_bytes(COUNTS.tobytes())
    _settings(tmp_path / "movie_settings.dat", saved=3, append=True)
    assert_whole(tmp_path / "movie.bin")


def test_a_single_frame_is_no_movie(tmp_path: Path) -> None:
    (tmp_path / "movie.bin").write_bytes(COUNTS[:1].tobytes())
    _settings(tmp_path / "movie_settings.dat", saved=1)
    refused(tmp_path / "movie.bin", "holds a single frame")


def test_settings_that_cannot_be_settings_arerefused(tmp_path: Path) -> None:
    (tmp_path / "movie.bin").write_bytes(COUNTS.tobytes())
    (tmp_path / "movie_settings.dat").write_bytes(b"\xff\x00" * 100)
    refused(tmp_path / "movie.bin", "does not say save/frame/shape")
    with (tmp_path / "movie_settings.dat").open("wb") as file:
        file.truncate(2**30)
    refused(tmp_path / "movie.bin", "has 10000000 at most")


def test_the_name_of_piscats_movies_tells_their_shape(tmp_path: Path) -> None:
    path = tmp_path / "control_7_6_5_uint16_2.33FPS.raw"
    path.write_bytes(COUNTS.tobytes())
    assert_whole(path)
    assert [row.given for row in read_table(tmp_path).rows] == [path.name]
    path.write_bytes(COUNTS[:-1].tobytes())  # then the name tells nothing
    refused(path, "if it is plain numbers, say so")


def test_a_folder_leaves_out_numbers_that_nothing_describes(tmp_path: Path) -> None:
    for name in ("movie", "movie_snapshot", "other", "movie_background"):
        (tmp_path / f"{name}.bin").write_bytes(COUNTS.tobytes())
    for name in ("movie", "movie_snapshot"):
        _settings(tmp_path / f"{name}_settings.dat")
    assert [row.given for row in read_table(tmp_path).rows] == ["movie.bin"]
