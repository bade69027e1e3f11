"""Movies that are not TIFF: NumPy, plain numbers, HDF5, Zarr; and TIFF in several files."""

from __future__ import annotations

import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
import zarr
from small_files import COUNTS, assert_whole, refused
from tiff_files import write_ome_set

from iscat_analysis.camera import refuse_overflow
from iscat_analysis.errors import DataError
from iscat_analysis.movie import MappedFrames, open_stack, path_beside, split_address

# ---- NumPy and plain numbers -----------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["u1", "<u2", ">u2", "<i4", "<f4", ">f8"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_reads_arrays_that_numpy_saved(tmp_path: Path, dtype: str, order: str) -> None:
    array = np.asarray(COUNTS % 200, dtype=dtype, order=order)  # type: ignore[call-overload]
    np.save(tmp_path / "movie.npy", array)
    assert_whole(tmp_path / "movie.npy", array)


def test_refuses_arrays_that_are_no_movie(tmp_path: Path) -> None:
    path = tmp_path / "movie.npy"
    np.save(path, COUNTS[0])
    refused(path, "movie.npy", "(6, 5)")
    np.save(path, COUNTS[:1])
    refused(path, "single frame")
    np.save(path, np.array([[["text"]] * 3] * 3, dtype=object))
    refused(path, "object")
    np.save(path, COUNTS.astype(complex))
    refused(path, "complex128")


@pytest.mark.parametrize("dtype", ["f2", "longdouble"])
def test_floats_that_no_kernel_takes_are_refused_in_every_format(
    tmp_path: Path, dtype: str
) -> None:
    pixels = COUNTS.astype(dtype)
    if pixels.dtype == np.float64:
        pytest.skip("this machine has no longer floats")
    name = str(pixels.dtype)
    np.save(tmp_path / "a.npy", pixels)
    refused(tmp_path / "a.npy", f"pixels are {name}; export it as integers")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["movie"] = pixels
    refused(tmp_path / "a.h5", name)
    with pytest.raises(DataError, match=name):
        open_stack(pixels)
    if dtype == "f2":
        tifffile.imwrite(tmp_path / "a.tif", pixels, photometric="minisblack")
        refused(tmp_path / "a.tif", name)


def test_an_array_that_is_cut_short_is_refused_at_every_length(tmp_path: Path) -> None:
    path = tmp_path / "movie.npy"
    np.save(path, COUNTS)
    whole = path.read_bytes()
    for size in range(8, len(whole), 13):
        path.write_bytes(whole[:size])
        refused(path, "movie.npy")


@pytest.mark.parametrize("part", ["7x6x5,uint16", "6x5,uint16", "7x6x5,<u2", "6x5, uint16"])
def test_reads_plain_numbers(tmp_path: Path, part: str) -> None:
    path = tmp_path / "movie.bin"
    path.write_bytes(COUNTS.tobytes())
    assert_whole(f"{path}::{part}")


def test_reads_plain_numbers_of_the_other_byte_order(tmp_path: Path) -> None:
    path = tmp_path / "movie.raw"
    path.write_bytes(COUNTS.astype(">u2").tobytes())
    assert_whole(f"{path}::6x5,>u2")


@pytest.mark.parametrize(
    ("part", "said"),
    [
        ("8x6x5,uint16", "needs 480"),
        ("6x4,uint16", "a multiple of 48"),
        ("6x5", "frames x rows x columns"),
        ("6x5,uint17", "uint17 is no type"),
        ("0x0x0,uint16", "check the shape"),
        ("0x5,uint16", "check the shape"),
        ("6x5,bool", "needs to be frames"),
    ],
)
def test_plain_numbers_of_another_size_are_refused(tmp_path: Path, part: str, said: str) -> None:
    path = tmp_path / "movie.bin"
    path.write_bytes(COUNTS.tobytes())
    refused(f"{path}::{part}", "movie.bin", said)


def smooth(rows: int = 32, columns: int = 48) -> np.ndarray:
    """Make a movie as a camera sees it: light that varies over the field, with its noise."""
    rng, y, x = np.random.default_rng(3), *np.indices((rows, columns))
    light = 3000 + 400 * np.sin(y / 3 + x / 5) + 300 * np.cos(x / 4)
    return rng.poisson(light, (9, rows, columns)).astype("<u2")


@pytest.mark.parametrize("stored", ["<u2", ">u2", "<i4", ">i4", "<f4", ">f4", ">f8"])
def test_the_byte_order_of_plain_numbers_is_told_by_their_smoothness(
    tmp_path: Path, stored: str
) -> None:
    counts = smooth().astype(stored)
    path = tmp_path / "movie.raw"
    path.write_bytes(counts.tobytes())
    assert_whole(f"{path}::32x48,{stored}", counts)
    wrong = counts.dtype.newbyteorder("S").str
    refused(f"{path}::32x48,{wrong}", "bytes", "the other way round", f"9x32x48,{stored}")


@pytest.mark.parametrize(
    "counts",
    [
        smooth() // 16 << 8,  # eight bits in the upper half of sixteen
        smooth() << 3,
        np.random.default_rng(5).integers(0, 65536, (9, 32, 48)).astype("<u2"),
        np.where(np.arange(9)[:, None, None] % 2, smooth(), smooth() // 300).astype("<u2"),
        np.full((9, 32, 48), 258, "<u2"),
        smooth()[:, ::-1, ::-1] % 256,
    ],
    ids=["8 bits", "13 bits", "noise", "flashes", "constant", "wrapped"],
)
def test_plain_numbers_that_are_right_are_not_taken_for_swapped(
    tmp_path: Path, counts: np.ndarray
) -> None:
    path = tmp_path / "movie.raw"
    path.write_bytes(counts.astype("<u2").tobytes())
    assert_whole(f"{path}::32x48,uint16", counts.astype("<u2"))


def test_arrays_with_swapped_bytes_are_named_before_they_seem_to_overflow() -> None:
    refuse_overflow(smooth(), "movie")
    with pytest.raises(DataError, match="movie: the bytes of its numbers are the other way round"):
        refuse_overflow(smooth().byteswap(), "movie")


def test_frames_that_are_stored_column_by_column(tmp_path: Path) -> None:
    counts = smooth()
    path = tmp_path / "movie.raw"
    path.write_bytes(counts.transpose(0, 2, 1).tobytes())
    assert_whole(f"{path}::32x48,uint16,order=columns", counts)
    assert_whole(f"{path}::48x32,uint16", counts.transpose(0, 2, 1))
    refused(f"{path}::32x48,uint16", "9x32x48,uint16,order=columns", "9x48x32,uint16")
    refused(f"{path}::48x32,uint16,order=columns", '::9x48x32,uint16"')
    with open_stack(f"{path}::32x48,uint16,order=columns") as stack:
        assert stack.in_place(0, 3) is None


def test_plain_numbers_behind_a_header(tmp_path: Path) -> None:
    path = tmp_path / "movie.raw"
    path.write_bytes(bytes(344) + COUNTS.tobytes() + b"")
    assert_whole(f"{path}::6x5,uint16,header=344")
    assert_whole(f"{path}::7x6x5,uint16, header=344,order=rows")
    refused(f"{path}::6x5,uint16,header=340", "header of 344", "::6x5,uint16,header=344")
    refused(f"{path}::7x6x5,uint16", '::7x6x5,uint16,header=344"')
    refused(f"{path}::8x6x5,uint16,header=344", "needs 480 behind a header of 344")
    refused(f"{path}::6x5,uint16,header=9999", "check the shape")
    refused(f"{path}::6x5,uint16,head=344", "header=344")
    assert path_beside(Path(f"{path}::6x5,uint16,header=344"), ".iscat") == tmp_path / "movie.iscat"


def test_a_file_of_unknown_numbers_says_how_to_name_them(tmp_path: Path) -> None:
    path = tmp_path / "movie.bin"
    path.write_bytes(COUNTS.tobytes())
    refused(path, "plain numbers", 'movie.bin::1500x128x128,uint16"')


def test_a_mapped_file_that_shrinks_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "movie.npy"
    np.save(path, COUNTS)
    with open_stack(path) as stack:
        path.write_bytes(path.read_bytes()[:200])
        with pytest.raises(DataError, match="shrank"):
            stack.read(0, 7)


def test_frames_lie_in_place_where_a_processor_can_use_them(tmp_path: Path) -> None:
    for name, stored, placed in (("little", "<u2", True), ("big", ">u2", False)):
        path = tmp_path / f"{name}.npy"
        np.save(path, COUNTS.astype(stored))
        with open_stack(path) as stack:
            found = stack.in_place(2, 5)
            assert (found is not None) == placed
            assert stack.without(COUNTS[0] < 0, np.empty(0, "u2")).in_place(2, 5) is None
            with pytest.raises(DataError, match="frame"):
                stack.in_place(2, 99)
        if found is not None:  # until nobody holds them, whether the stack is closed or not
            found.let_go()
            np.testing.assert_array_equal(found.counts, COUNTS[2:5])
        with pytest.raises(ValueError, match="closed"):
            stack.in_place(2, 5)
    np.save(tmp_path / "columns.npy", np.asfortranarray(COUNTS))
    (tmp_path / "odd.bin").write_bytes(b"0" + COUNTS.tobytes())
    odd = MappedFrames(tmp_path / "odd.bin", COUNTS.shape, COUNTS.dtype, offset=1)
    assert odd.in_place(0, 2) is None
    np.testing.assert_array_equal(odd.read(0, 7), COUNTS)
    odd.close()
    with open_stack(tmp_path / "columns.npy") as stack:
        assert stack.in_place(0, 2) is None


def test_frames_of_a_tiff_lie_in_place_unless_something_is_between_them(tmp_path: Path) -> None:
    for name, options, placed in (
        ("together", {}, True),
        ("packed", {"compression": "zlib"}, False),
        ("apart", {"contiguous": False}, False),
    ):
        path = tmp_path / f"{name}.tif"
        with tifffile.TiffWriter(path) as file:
            if options:
                for frame in COUNTS:
                    file.write(frame, photometric="minisblack", **options)
            else:
                file.write(COUNTS, photometric="minisblack")
        with open_stack(path) as stack:
            found = stack.in_place(1, 6)
            assert (found is not None) == placed
            if found is not None:
                np.testing.assert_array_equal(found.counts, stack.read(1, 6))


# ---- HDF5 ------------------------------------------------------------------------------------


def test_reads_the_dataset_that_is_named(tmp_path: Path) -> None:
    path = tmp_path / "day.h5"
    with h5py.File(path, "w") as file:
        file["run 3/movie"] = COUNTS
        file.create_dataset("packed", data=COUNTS[::-1], chunks=(2, 4, 5), compression="gzip")
        file["five"] = COUNTS[:, None, None]
        file["note"] = "text"
        file["flat"] = COUNTS[0]
    assert_whole(f"{path}::/run 3/movie")
    assert_whole(f"{path}::packed", COUNTS[::-1])
    assert_whole(f"{path}::/five")
    refused(path, "holds 3 datasets", "/run 3/movie", "day.h5::/")
    refused(f"{path}::/run 4/movie", "is not there", "/packed")
    refused(f"{path}::/flat", "(6, 5)")
    refused(f"{path}::/note", "note")


def test_takes_the_only_dataset_of_frames_and_says_so(tmp_path: Path) -> None:
    path = tmp_path / "day.h5"
    with h5py.File(path, "w") as file:
        file["run/movie"] = COUNTS
        file["run/times"] = np.arange(7.0)
    assert_whole(path)
    with open_stack(path) as stack:
        assert "/run/movie" in stack.notes[0]
        assert stack.name == "day.h5"
    with h5py.File(path, "w") as file:
        file["times"] = np.arange(7.0)
    refused(path, "holds no frames")


# ---- Zarr ------------------------------------------------------------------------------------


def _ome_zarr(folder: Path, counts: np.ndarray, axes: str, **units: str) -> None:
    group = zarr.open_group(str(folder), mode="w")
    array = group.create_array("0", shape=counts.shape, chunks=(2, *counts.shape[1:]), dtype="u2")
    array[:] = counts
    scale = [{"t": 0.004, "x": 0.0844, "y": 0.0844}.get(axis, 1.0) for axis in axes]
    group.attrs["ome"] = {
        "version": "0.5",
        "multiscales": [
            {
                "axes": [
                    {"name": axis, **({"unit": units[axis]} if axis in units else {})}
                    for axis in axes
                ],
                "datasets": [
                    {"path": "0", "coordinateTransformations": [{"type": "scale", "scale": scale}]}
                ],
            }
        ],
    }


def test_reads_ome_zarr_with_its_scale(tmp_path: Path) -> None:
    path = tmp_path / "movie.zarr"
    _ome_zarr(path, COUNTS[:, None, None], "tczyx", t="second", x="micrometer", y="micrometer")
    assert_whole(path)
    with open_stack(path) as stack:
        assert stack.metadata.pixel_size_nm == pytest.approx(84.4)
        assert stack.metadata.frame_rate_hz == pytest.approx(250.0)
        first = stack.sha256(), stack.identity
    chunk = next(file for file in path.rglob("*") if file.is_file() and file.name == "0")
    chunk.write_bytes(chunk.read_bytes() + b"\0")
    with open_stack(path) as stack:
        assert stack.sha256() != first[0]
        assert stack.identity != first[1]


def test_without_units_nothing_is_said_of_the_scale(tmp_path: Path) -> None:
    _ome_zarr(tmp_path / "movie.zarr", COUNTS, "tyx")
    with open_stack(tmp_path / "movie.zarr") as stack:
        assert stack.metadata.pixel_size_nm is None
        assert stack.metadata.frame_rate_hz is None


def test_refuses_ome_zarr_with_channels_or_heights(tmp_path: Path) -> None:
    _ome_zarr(tmp_path / "movie.zarr", np.stack([COUNTS, COUNTS], axis=1), "tcyx")
    refused(tmp_path / "movie.zarr", "t 7, c 2, y 6, x 5")
    _ome_zarr(tmp_path / "movie.zarr", COUNTS, "zyx")
    refused(tmp_path / "movie.zarr", "z 7, y 6, x 5")


def test_reads_arrays_of_a_zarr_folder(tmp_path: Path) -> None:
    path = tmp_path / "day.zarr"
    group = zarr.open_group(str(path), mode="w")
    group.create_array("movie", data=COUNTS)
    assert_whole(path)
    group.create_array("other", data=COUNTS)
    refused(path, "/movie", "/other")
    assert_whole(f"{path}::/movie")
    refused(f"{path}::/lost", "day.zarr::/lost")


def test_says_which_package_reads_zarr(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    zarr.open_group(str(tmp_path / "day.zarr"), mode="w")
    monkeypatch.setitem(sys.modules, "zarr", None)
    refused(tmp_path / "day.zarr", 'pip install "iscat-analysis[zarr]"')


# ---- films and other files -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"RIFF\x00\x00\x00\x00AVI LIST", "AVI film"),
        (b"\x00\x00\x00\x18ftypmp42\x00\x00", "film"),
        (b"\x1aE\xdf\xa3\x01\x00\x00\x00\x00", "Matroska film"),
    ],
)
def test_films_are_refused_because_they_keep_no_counts(
    tmp_path: Path, content: bytes, said: str
) -> None:
    (tmp_path / "movie.tif").write_bytes(content)
    refused(tmp_path / "movie.tif", said, "keeps no counts")


def test_of_a_folder_that_is_no_movie_it_is_said_what_to_do(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "frame_0.tif", COUNTS[0])
    refused(tmp_path, "is a folder", "a frame each", "iscat batch")


# ---- TIFF in several files -------------------------------------------------------------------


def test_reads_a_movie_in_several_files_from_any_of_them(tmp_path: Path) -> None:
    paths = write_ome_set(tmp_path, COUNTS)
    hashes = set()
    for path in paths:
        assert_whole(path)
        with open_stack(path) as stack:
            assert stack.metadata.pixel_size_nm == pytest.approx(84.4)
            assert stack.metadata.frame_rate_hz == pytest.approx(250.0)
            hashes.add(stack.sha256())
    assert len(hashes) == 1
    tifffile.imwrite(paths[2], COUNTS[6] + 1, metadata=None)
    with open_stack(paths[0]) as stack:
        assert stack.sha256() not in hashes


def test_a_set_with_a_part_missing_is_refused(tmp_path: Path) -> None:
    paths = write_ome_set(tmp_path, COUNTS)
    paths[1].unlink()
    refused(paths[0], "one of 3 files", "m_1.ome.tif is not beside it")


def test_a_set_that_is_cut_short_is_refused(tmp_path: Path) -> None:
    paths = write_ome_set(tmp_path, COUNTS)
    tifffile.imwrite(paths[1], COUNTS[3:5], metadata=None)
    refused(paths[0], "m_1.ome.tif: holds 2 images", "says 3")
    paths = write_ome_set(tmp_path, COUNTS, lost=2)
    refused(paths[0], "does not say where 2 of 7 frames lie")


def test_parts_of_another_kind_or_elsewhere_are_refused(tmp_path: Path) -> None:
    paths = write_ome_set(tmp_path, COUNTS)
    tifffile.imwrite(paths[1], COUNTS[3:6].astype("u1"), metadata=None)
    refused(paths[0], "m_1.ome.tif", "other pixels")
    paths = write_ome_set(tmp_path, COUNTS, elsewhere="../")
    refused(paths[0], "other folders")


# ---- names -----------------------------------------------------------------------------------


def test_results_lie_beside_the_movie(tmp_path: Path) -> None:
    assert path_beside(Path("a/movie.tif"), ".iscat") == Path("a/movie.iscat")
    assert path_beside(Path("a/day.h5::/run 3/movie"), ".iscat") == Path("a/day.run 3.movie.iscat")
    assert path_beside(Path("a/movie.bin::6x5,uint16"), ".iscat") == Path("a/movie.iscat")
    odd = tmp_path / "a::b.tif"
    odd.touch()
    assert split_address(odd) == (odd, "")
    assert path_beside(odd, ".iscat") == tmp_path / "a::b.iscat"


def test_parts_of_one_file_are_different_movies(tmp_path: Path) -> None:
    path = tmp_path / "day.h5"
    with h5py.File(path, "w") as file:
        file["a"], file["b"] = COUNTS, COUNTS
    with open_stack(f"{path}::/a") as a, open_stack(f"{path}::/b") as b:
        assert a.name == "day.h5::/a"
        assert a.identity != b.identity
        assert a.sha256() != b.sha256()
