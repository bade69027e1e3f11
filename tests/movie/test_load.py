"""Every kind of TIFF movie is read whole, frame for frame, or refused."""

from __future__ import annotations

import hashlib
import os
import struct
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile
from small_files import assert_whole, refused
from tiff_files import ASCII, LONG, RATIONAL, SHORT, movie, write_pages, write_stk, write_tiff

from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.movie import open_stack, open_tiff, tiff
from iscat_analysis.records import FrameSource, StackMetadata

WRITERS = {"shaped": {}, "ome": {"ome": True}, "imagej": {"imagej": True}}
LAYOUTS = {
    "contiguous": {},
    "bigtiff": {"bigtiff": True},
    "big-endian": {"byteorder": ">"},
    "big-endian bigtiff": {"bigtiff": True, "byteorder": ">"},
    "strips": {"rowsperstrip": 3},
    "tiles": {"tile": (16, 16)},
    "lzw": {"compression": "lzw"},
    "deflate": {"compression": "zlib"},
    "deflate strips": {"compression": "zlib", "rowsperstrip": 3},
    "zstd tiles": {"compression": "zstd", "tile": (16, 16)},
    "big-endian lzw": {"compression": "lzw", "byteorder": ">"},
    "no description": {"metadata": None},
    "one directory": {"truncate": True},
}


@pytest.mark.parametrize("options", LAYOUTS.values(), ids=LAYOUTS.keys())
@pytest.mark.parametrize("dtype", ["u1", "u2", "u4", "i2", "f4"])
def test_reads_every_layout_and_type(tmp_path: Path, dtype: str, options: dict) -> None:
    expected = movie(6, 19, 21, dtype)
    path = tmp_path / "movie.tif"
    tifffile.imwrite(path, expected, **options)
    assert_whole(path, expected)


@pytest.mark.parametrize("dtype", ["u1", "u2"])
def test_undoes_the_predictor(tmp_path: Path, dtype: str) -> None:
    expected = movie(dtype=dtype)
    tifffile.imwrite(tmp_path / "m.tif", expected, compression="zlib", predictor=True)
    assert_whole(tmp_path / "m.tif", expected)


@pytest.mark.parametrize("axes", ["TYX", "ZYX", "TZCYX", "QYX"])
@pytest.mark.parametrize("kind", ["shaped", "ome", "imagej"])
def test_finds_the_time_axis(tmp_path: Path, kind: str, axes: str) -> None:
    if (kind, axes) in {("imagej", "QYX"), ("ome", "ZYX")}:
        pytest.skip("ImageJ has no such axis, and OME-XML always names a length of time")
    expected = movie()
    data = expected.reshape(6, *([1] * (len(axes) - 3)), 10, 14)
    tifffile.imwrite(tmp_path / "m.tif", data, metadata={"axes": axes}, **WRITERS[kind])
    assert_whole(tmp_path / "m.tif", expected)


@pytest.mark.parametrize("kind", ["shaped", "imagej"])
def test_heights_without_any_time_are_frames_and_are_said_to_be(tmp_path: Path, kind: str) -> None:
    for axes, notes in (("ZYX", 1), ("TYX", 0)):
        tifffile.imwrite(tmp_path / "m.tif", movie(), metadata={"axes": axes}, **WRITERS[kind])
        with open_stack(tmp_path / "m.tif") as stack:
            assert len(stack.notes) == notes
            assert all("Z (height)" in note for note in stack.notes)


@pytest.mark.parametrize("kind", ["imagej", "ome"])
def test_takes_many_unnamed_channels_as_time(tmp_path: Path, kind: str) -> None:
    expected = movie(frames=9)  # tifffile writes C = 9 when it is given no axes
    tifffile.imwrite(tmp_path / "m.tif", expected, **WRITERS[kind])
    assert_whole(tmp_path / "m.tif", expected)


HEIGHTS = movie(30).reshape(1, 30, 1, 10, 14)
CHANNELS = movie(10).reshape(5, 2, 10, 14)
NO_MOVIES: list[tuple[np.ndarray, dict, str]] = [
    *((HEIGHTS, {**WRITERS[kind], "metadata": {"axes": "TZCYX"}},
       "Z (height) of length 30 and T (time) of length 1") for kind in ("shaped", "ome")),
    *((CHANNELS, {**options, "metadata": {"axes": "TCYX"}}, "C (channel) of length 2")
      for options in WRITERS.values()),
    (movie(6).reshape(3, 2, 10, 14), {}, "of length 3 and number 2 of length 2"),
    (movie(3), {"imagej": True, "metadata": {"axes": "CYX"}},
     "C (channel) of length 3, which is not time"),
    (np.zeros((4, 10, 14, 3), "u1"), {"photometric": "rgb", "planarconfig": "contig"}, "colour"),
    (np.zeros((4, 3, 10, 14), "u1"), {"photometric": "rgb", "planarconfig": "separate"}, "colour"),
    *((movie(1)[0], options, "single frame") for options in WRITERS.values()),
    (movie(5, 16, 16, "u1"), {"compression": "jpeg"}, "JPEG"),
    (movie(5).astype("c8"), {}, "sample format 6"),
]  # fmt: skip


@pytest.mark.parametrize(("data", "options", "said"), NO_MOVIES)
def test_what_is_no_movie_is_refused(
    tmp_path: Path, data: np.ndarray, options: dict, said: str
) -> None:
    tifffile.imwrite(tmp_path / "m.tif", data, **options)
    refused(tmp_path / "m.tif", str(tmp_path / "m.tif"), said)


# --- movies written frame by frame -------------------------------------------------------------


def _written(path: Path, blocks: Iterable[np.ndarray], **options: Any) -> None:
    with tifffile.TiffWriter(path, **options) as writer:
        for block in blocks:
            writer.write(block)


@pytest.mark.parametrize("options", [{}, {"ome": True}], ids=["default", "ome"])
def test_reads_a_movie_written_frame_by_frame_or_in_blocks(tmp_path: Path, options: dict) -> None:
    path, expected = tmp_path / "m.tif", movie(25)
    _written(path, expected, **options)
    assert tifffile.imread(path).ndim == 2  # the trap is set
    assert_whole(path, expected)
    if not options:
        _written(path, expected.reshape(5, 5, 10, 14))
        assert_whole(path, expected)


def test_two_thousand_frames_are_read_whole_with_work_in_proportion(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parse = tifffile.TiffPage.__init__
    parsed: list[int] = []

    def counted(self: object, *args: object, **kwargs: object) -> None:
        parsed.append(1)
        parse(self, *args, **kwargs)

    monkeypatch.setattr(tifffile.TiffPage, "__init__", counted)
    calls = {}
    for frames in (500, 2000):
        path = tmp_path / f"{frames}.tif"
        expected = np.arange(frames * 4, dtype="u2").reshape(frames, 2, 2)
        _written(path, expected)
        parsed.clear()
        calls[frames] = _count_calls(lambda path=path: open_stack(path).close())
        assert frames <= len(parsed) < frames + 5
        assert_whole(path, expected)
    assert calls[2000] < 4.2 * calls[500]  # 4 is proportional, 16 would be quadratic


def _count_calls(work: Callable[[], object]) -> int:
    count = 0

    def profile(_frame: object, event: str, _argument: object) -> None:
        nonlocal count
        count += event in ("call", "c_call")

    previous = sys.getprofile()
    sys.setprofile(profile)
    try:
        work()
    finally:
        sys.setprofile(previous)
    return count


# --- files that are not what they say ----------------------------------------------------------


def test_refuses_what_is_not_there(tmp_path: Path) -> None:
    refused(tmp_path / "absent.tif", "no such file")
    refused(tmp_path, "is a folder")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no such pipes")
def test_refuses_a_pipe_without_waiting_for_it(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "m.tif")
    refused(tmp_path / "m.tif", "is a pipe or a device")


def test_says_what_the_system_says_of_a_folder_that_is_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def denied(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "stat", denied)
    refused(tmp_path / "m.tif", "m.tif: cannot be read (Permission denied)")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "empty"),
        (b"hello, I am text", "needs to be a TIFF file"),
        (b"\x89HDF\r\n\x1a\n", "an HDF5 file"),
        (b"\x93NUMPY\x01\x00", "a NumPy array"),
        (b"II\x2a\x00", "truncated"),
        (b"II\x2b\x00\x08\x00\x00\x00", "truncated"),
        (b"II\x2a\x00\x00\x00\x00\x00", "holds no image"),
        (b"II\x2a\x00\xff\xff\x00\x00", "breaks off after 0"),
        (b"II\x2a\x00\x08\x00\x00\x00\x00\x00\x00\x00\x00\x00", "damaged"),
    ],
)
def test_refuses_other_files(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "m.tif"
    path.write_bytes(content)
    refused(path, f"{path}: ", message)


@pytest.mark.parametrize("options", LAYOUTS.values(), ids=LAYOUTS.keys())
def test_finds_truncation_at_every_length(tmp_path: Path, options: dict) -> None:
    tifffile.imwrite(tmp_path / "whole.tif", movie(5, 16, 16), **options)
    whole = (tmp_path / "whole.tif").read_bytes()
    cut = tmp_path / "cut.tif"
    with open_stack(tmp_path / "whole.tif") as stack:
        expected = stack.read(0, 5)
    refused = 0
    for length in range(1, len(whole), max(1, len(whole) // 60)):
        cut.write_bytes(whole[:length])
        try:
            stack = open_stack(cut)
        except DataError:
            refused += 1
            continue
        with stack:  # only padding was lost, so nothing that matters
            np.testing.assert_array_equal(stack.read(0, 5), expected)
    assert refused > 50


def test_names_the_frame_where_a_truncated_file_ends(tmp_path: Path) -> None:
    path = write_pages(tmp_path / "m.tif", movie(5))
    path.write_bytes(path.read_bytes()[:-1])
    refused(path, "truncated (the pixels of image 4")


def test_finds_truncation_without_reading_pixels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tifffile.imwrite(tmp_path / "m.tif", movie(5), compression="zlib")
    # tifffile keeps every decoder that it looked up: one is replaced where it keeps them.
    monkeypatch.setattr(tifffile.TIFF, "DECOMPRESSORS", {tifffile.COMPRESSION.ADOBE_DEFLATE: None})
    with open_stack(tmp_path / "m.tif") as stack, pytest.raises(DataError, match="decompressed"):
        stack.read(0, 1)  # the trap is set


def test_refuses_a_circle_of_directories(tmp_path: Path) -> None:
    refused(write_pages(tmp_path / "m.tif", movie(3), loop=True), "circle after 3")


@pytest.mark.parametrize(
    "description", ["ImageJ=1.53t\nimages=9\nframes=9\n", '{"shape": [9, 10, 14]}']
)
def test_refuses_fewer_frames_than_described(tmp_path: Path, description: str) -> None:
    path = write_pages(tmp_path / "m.tif", movie(3), page_tags={0: {270: (ASCII, description)}})
    refused(path, "describes 9 frames but holds 3")


def test_reads_the_imagej_convention_for_large_files(tmp_path: Path) -> None:
    data = movie(7)
    description = "ImageJ=1.53t\nimages=7\nframes=7\n"
    path = write_tiff(
        tmp_path / "m.tif",
        [data.astype(">u2").tobytes()],
        data.shape[1:],
        order=">",
        tags={270: (ASCII, description), 279: (LONG, [280])},
    )
    assert_whole(path, data)
    path.write_bytes(path.read_bytes()[:-1])
    refused(path, "truncated (its 7 frames")


IMAGEJ = "ImageJ=1.53t\nimages={0}\nframes={0}\nunit=nm\nloop=false\n"


def _described_pages(path: Path, pages: int, images: int, every: int = 1) -> Path:
    """Write pages of which every so many describe so many images, as Fiji does."""
    tags: dict = {k: {270: (ASCII, IMAGEJ.format(images))} for k in range(0, pages, every)}
    return write_pages(path, movie(pages), page_tags=tags)


def test_a_description_on_every_page_counts_once(tmp_path: Path) -> None:
    assert_whole(_described_pages(tmp_path / "m.tif", 12, 12), movie(12))
    assert_whole(_described_pages(tmp_path / "m.tif", 12, 6), movie(12))  # two stacks joined
    assert_whole(_described_pages(tmp_path / "m.tif", 12, 6, every=6), movie(12))
    assert_whole(_described_pages(tmp_path / "m.tif", 12, 1), movie(12))


@pytest.mark.parametrize(
    ("pages", "images", "every", "described"),
    [(9, 12, 1, 12), (9, 6, 1, 12), (9, 6, 6, 12), (11, 12, 12, 12)],
)
def test_a_description_on_every_page_hides_no_missing_frame(
    tmp_path: Path, pages: int, images: int, every: int, described: int
) -> None:
    path = _described_pages(tmp_path / "m.tif", pages, images, every)
    refused(path, f"describes {described} frames but holds {pages}")


def test_a_hyperstack_described_on_every_page_is_refused_by_its_axes(tmp_path: Path) -> None:
    text = "ImageJ=1.53t\nimages=12\nchannels=2\nframes=6\nhyperstack=true\n"
    path = write_pages(tmp_path / "m.tif", movie(12), tags={270: (ASCII, text)})
    refused(path, "C (channel) of length 2 and T (time) of length 6")


# --- MetaMorph ---------------------------------------------------------------------------------


def test_reads_the_planes_of_metamorph_with_their_times(tmp_path: Path) -> None:
    expected = movie(8)
    path = write_stk(tmp_path / "m.stk", expected, um_per_px=0.0844)
    assert_whole(path, expected)
    with open_stack(path) as stack:
        assert stack.in_place(2, 5) is not None
        found = stack.metadata
    assert (found.pixel_size_nm, found.source) == (pytest.approx(84.4), "metamorph")
    assert found.frame_rate_hz == pytest.approx(200, rel=1e-3)
    times = [86_399_990 + 5 * k for k in (0, 1, 2, 3, 6, 7, 8, 9)]  # over midnight, two dropped
    with open_stack(write_stk(path, expected, times_ms=times)) as stack:
        assert stack.metadata.ticks == (0, 1, 2, 3, 6, 7, 8, 9)
        assert stack.metadata.pixel_size_nm is None


def test_metamorph_that_is_cut_short_or_alone_is_refused(tmp_path: Path) -> None:
    path = write_stk(tmp_path / "m.stk", movie(8))
    whole = path.read_bytes()
    for lost in (1, 280, 281, 8 * 280 - 1):
        path.write_bytes(whole[:-lost])
        refused(path, "truncated")
    refused(write_stk(path, movie(1)), "single frame")
    refused(write_stk(path, movie(8), tags={259: (SHORT, [8])}), "describes 8 frames but holds 1")
    path.write_bytes(whole[:8] + whole[8:].replace(struct.pack("<HHI", 33629, 5, 8), b"\xff" * 8))
    refused(path, "single frame")


def test_an_absurd_count_costs_no_memory(tmp_path: Path) -> None:
    text = f"ImageJ=1.53t\nimages={10**15}\n"
    refused(write_pages(tmp_path / "m.tif", movie(1), tags={270: (ASCII, text)}), "truncated")


def test_refuses_frames_that_differ(tmp_path: Path) -> None:
    _written(tmp_path / "m.tif", [np.zeros((10, 14), "u2"), np.zeros((10, 12), "u2")])
    refused(tmp_path / "m.tif", "image 1 is 10 x 12 pixels of uint16 but the first is 10 x 14")


def test_leaves_out_thumbnails(tmp_path: Path) -> None:
    expected = movie(5)
    with tifffile.TiffWriter(tmp_path / "m.tif") as writer:
        for frame in expected:
            writer.write(frame, metadata=None)
        writer.write(expected[0, ::2, ::2], subfiletype=1, metadata=None)
    assert_whole(tmp_path / "m.tif", expected)


def test_reads_frames_at_uneven_places(tmp_path: Path) -> None:
    tags: dict = {2: {305: (ASCII, "a text that is longer than the others")}}
    assert_whole(write_pages(tmp_path / "m.tif", movie(5), page_tags=tags, gap=3), movie(5))


@pytest.mark.parametrize(
    ("size", "said"), [(0, "has no pixel data"), (100, "needs more than the 100 bytes")]
)
def test_refuses_missing_pixels(tmp_path: Path, size: int, said: str) -> None:
    path = write_pages(tmp_path / "m.tif", movie(3), page_tags={1: {279: (LONG, [size])}})
    refused(path, f"image 1 {said}")


@pytest.mark.parametrize("size", [10_000, 2**31])
def test_refuses_decompression_bombs(tmp_path: Path, size: int) -> None:
    path = write_tiff(
        tmp_path / "m.tif",
        [b"x" * 100] * 3,
        (size, size),
        tags={259: (SHORT, [8]), 278: (LONG, [size])},
    )
    refused(path, "damaged")


def test_says_which_frame_cannot_be_decompressed(tmp_path: Path) -> None:
    expected = movie(5, 32, 32)
    path = tmp_path / "m.tif"
    tifffile.imwrite(path, expected, compression="zlib")
    with tifffile.TiffFile(path) as file:
        offset = file.pages[2].dataoffsets[0]
    raw = bytearray(path.read_bytes())
    raw[offset : offset + 8] = b"\xff" * 8
    path.write_bytes(raw)
    with open_stack(path) as stack:
        np.testing.assert_array_equal(stack.read(0, 2), expected[:2])
        with pytest.raises(DataError, match="frame 2 cannot be decompressed"):
            stack.read(1, 3)


def test_unpacks_twelve_bits(tmp_path: Path) -> None:
    expected = movie(5, 10, 14) * 16
    pages = [_pack_twelve(frame) for frame in expected]
    path = write_tiff(tmp_path / "m.tif", pages, (10, 14), bits=12)
    assert_whole(path, expected)


def _pack_twelve(frame: np.ndarray) -> bytes:
    pairs = frame.reshape(-1, 2).astype(int)
    return b"".join(struct.pack(">I", int(a) << 20 | int(b) << 8)[:3] for a, b in pairs)


def test_a_text_that_cannot_be_decoded_is_not_passed_over(tmp_path: Path) -> None:
    """OME-XML with a byte that is no text: without it the file would seem to be five frames."""
    text = (
        '<?xml version="1.0"?><OME><Image><Pixels SizeT="2" SizeZ="1" SizeC="1" A="\x81"/></Image>'
    )
    path = write_pages(tmp_path / "m.tif", movie(5), page_tags={0: {270: (ASCII, text)}})
    path.write_bytes(path.read_bytes().replace("\x81".encode(), b"\x81\x20"))
    refused(path, "OME-XML")


def test_compressed_pixels_need_a_length(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "m.tif", movie(5), compression="zlib")
    raw = bytearray((tmp_path / "m.tif").read_bytes())
    with tifffile.TiffFile(tmp_path / "m.tif") as file:
        at = file.pages[1].tags[279].offset
    struct.pack_into("<H", raw, at, 65000)
    (tmp_path / "m.tif").write_bytes(raw)
    refused(tmp_path / "m.tif", "image 1 does not say how long")


def test_reads_beyond_four_gigabytes(tmp_path: Path) -> None:
    """A BigTIFF of 5 GB, nearly all of it a hole that takes no room on the disk."""
    path, shape = tmp_path / "m.tif", (600, 2048, 2048)
    frames = tifffile.memmap(path, shape=shape, dtype="u2", bigtiff=True, photometric="minisblack")
    frames[-1, -1, -1] = 12345
    frames.flush()
    assert path.stat().st_size > 5e9
    with open_stack(path) as stack:
        assert stack.shape == shape
        assert int(stack.read(599, 600)[0, -1, -1]) == 12345


# --- arrays --------------------------------------------------------------------------------------


class Sliced:
    """An array that gives nothing but a shape, a type and slices, as Dask and Zarr do."""

    def __init__(self, values: np.ndarray) -> None:
        self._values = values
        self.shape, self.dtype = values.shape, values.dtype
        self.largest = 0

    def __getitem__(self, key: slice) -> list:
        self.largest = max(self.largest, key.stop - key.start)
        return self._values[key].tolist()


def test_reads_arrays_of_any_library(tmp_path: Path) -> None:
    expected = movie(9)
    np.save(tmp_path / "m.npy", expected)
    mapped = np.load(tmp_path / "m.npy", mmap_mode="r")
    with h5py.File(tmp_path / "m.h5", "w") as file:
        arrays = {
            "numpy": expected,
            "mapped": mapped,
            "big-endian": expected.astype(">u2"),
            "Fortran": np.asfortranarray(expected),
            "h5py": file.create_dataset("a", data=expected, chunks=(2, 5, 14)),
            "slices": Sliced(expected),
        }
        hashes = set()
        for name, array in arrays.items():
            with open_stack(array, name=name, pixel_size_nm=84.4, frame_rate_hz=200) as stack:
                assert stack.name == name
                assert stack.metadata == StackMetadata(84.4, None, 200, source="arguments")
                assert stack.dtype == np.dtype("u2")
                block = stack.read(2, 5)
                np.testing.assert_array_equal(block, expected[2:5])
                assert block.flags.writeable
                assert block.flags.owndata
                hashes.add(stack.sha256())
        assert len(hashes) == 1
        block[:] = 0
        assert expected[2:5].any()
    with open_stack(expected[:, ::-1]) as stack:
        assert stack.sha256() not in hashes
        assert stack.name == "array"
        assert stack.metadata == StackMetadata()


def test_an_array_is_read_a_few_frames_at_a_time() -> None:
    array = Sliced(np.zeros((300, 100, 100), "u2"))
    with open_stack(array) as stack:
        for _ in stack.chunks(memory_mb=1):
            pass
    assert array.largest == 50


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((10, 14)), r"shape \(10, 14\)"),
        (np.zeros((2, 10, 14, 3)), r"frames \(t, y, x\)"),
        (np.zeros((0, 10, 14)), "shape"),
        (np.zeros((1, 10, 14)), "single frame"),
        (np.zeros((3, 10, 14), complex), "complex128"),
        (np.full((3, 10, 14), "a"), "<U1"),
        ([[[1, 2], [3, 4]]] * 3, "^list is no movie"),
        (None, "^NoneType is no movie"),
    ],
)
def test_refuses_arrays_that_are_no_movie(array: object, message: str) -> None:
    with pytest.raises(DataError, match=message):
        open_stack(array)  # type: ignore[arg-type]


def test_refuses_to_describe_a_file_twice(path: Path) -> None:
    for key, value in (("name", "x"), ("pixel_size_nm", 84.4)):
        with pytest.raises(ConfigError, match=key):
            open_stack(path, **{key: value})
    for value in (0.0, -1.0, np.nan):
        with pytest.raises(ConfigError, match="exposure_ms"):
            open_stack(movie(), exposure_ms=value)


# --- the stack ---------------------------------------------------------------------------------


@pytest.fixture
def path(tmp_path: Path) -> Path:
    tifffile.imwrite(tmp_path / "movie.tif", movie(10))
    return tmp_path / "movie.tif"


def test_stack_is_a_frame_source(path: Path) -> None:
    with open_stack(path) as stack:
        source: FrameSource = stack
        assert source.name == "movie.tif"
        assert repr(stack) == "<Stack movie.tif: 10 frames of 10 x 14 pixels, uint16>"
        assert stack.sha256() == hashlib.sha256(path.read_bytes()).hexdigest()
        assert stack.path == path
        assert stack.read(3, 3).shape == (0, 10, 14)
    assert "closed" in repr(stack)
    stack.close()
    with pytest.raises(ValueError, match="closed"):
        stack.read(0, 1)


@pytest.mark.parametrize("bounds", [(0, 11), (-1, 3), (5, 4), (11, 12)])
def test_refuses_frames_outside_the_movie(path: Path, bounds: tuple[int, int]) -> None:
    with open_stack(path) as stack, pytest.raises(DataError, match=r"it holds \[0, 10\)"):
        stack.read(*bounds)


@pytest.mark.parametrize("frames_per_block", [0.5, 1, 3, 10, 99])
def test_chunks_cover_the_range_once(path: Path, frames_per_block: float) -> None:
    megabytes = frames_per_block * 10 * 14 * 2 / 1e6
    with open_stack(path) as stack:
        blocks = list(stack.chunks(1, 9, memory_mb=megabytes))
        assert [first for first, _ in blocks] == list(range(1, 9, max(1, int(frames_per_block))))
        assert all(len(block) <= max(1, frames_per_block) for _, block in blocks)
        np.testing.assert_array_equal(np.concatenate([b for _, b in blocks]), movie(10)[1:9])
        assert sum(len(block) for _, block in stack.chunks()) == 10
        with pytest.raises(ValueError, match="memory_mb"):
            next(stack.chunks(memory_mb=0))


def test_refuses_a_file_that_shrinks_while_open(path: Path) -> None:
    with open_stack(path) as stack:
        path.write_bytes(path.read_bytes()[:100])
        with pytest.raises(DataError, match="shrank"):
            stack.read(0, 10)


def test_resolution_tags_of_a_printer_are_ignored(tmp_path: Path) -> None:
    tags = {282: (RATIONAL, [300, 1]), 283: (RATIONAL, [300, 1]), 296: (SHORT, [2])}
    with open_stack(write_pages(tmp_path / "m.tif", movie(3), tags=tags)) as stack:
        assert stack.metadata.pixel_size_nm is None
        assert stack.metadata.source == "none"


# --- headers that repeat -------------------------------------------------------------------------


@pytest.fixture
def read_whole(monkeypatch):
    """Count the headers that tifffile reads."""
    pages = []
    original = tiff.repetition_of

    def counted(*arguments):
        pages.append(arguments)
        return original(*arguments)

    monkeypatch.setattr(tiff, "repetition_of", counted)
    return pages


@pytest.mark.parametrize("options", [{}, {"bigtiff": True}, {"byteorder": ">"}])
def test_repeated_headers_are_not_read_again(tmp_path, read_whole, options):
    counts, path = movie(40, 6, 7), tmp_path / "movie.tif"
    with tifffile.TiffWriter(path, **options) as file:
        for frame in counts:
            file.write(frame, contiguous=False, metadata=None, resolution=(11, 12))
    frames = open_tiff(path)
    assert np.array_equal(frames.read(0, 40), counts)
    assert np.array_equal(frames.read(13, 14), counts[13:14])
    frames.close()
    assert len(read_whole) < 4


def test_an_image_that_differs_is_read_and_judged(tmp_path, read_whole):
    counts, path = movie(20, 6, 7), tmp_path / "movie.tif"
    with tifffile.TiffWriter(path) as file:
        for number, frame in enumerate(counts):
            text = "the laser was changed" if number == 11 else None
            file.write(frame, contiguous=False, metadata=None, description=text)
    frames = open_tiff(path)
    assert np.array_equal(frames.read(0, 20), counts)
    frames.close()
    assert 1 < len(read_whole) < 6
    with tifffile.TiffWriter(path) as file:
        for number, frame in enumerate(counts):
            part = frame[:5] if number == 11 else frame
            file.write(part, contiguous=False, metadata=None)
    with pytest.raises(DataError, match=r"image 11 is 5 x 7 pixels of uint16"):
        open_tiff(path)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ("pixels outside", "is truncated"),
        ("no pixels", "has no pixel data"),
        ("next outside", "breaks off"),
        ("circle", "circle|breaks off"),
    ],
)
def test_a_damaged_header_among_equal_ones_is_refused(tmp_path, change, complaint):
    counts, path = movie(20, 6, 7), tmp_path / "movie.tif"
    with tifffile.TiffWriter(path) as file:
        for frame in counts:
            file.write(frame, contiguous=False, metadata=None)
    with tifffile.TiffFile(path) as file:
        page, earlier = file.pages[15], file.pages[5]
        place = page.tags[273].offset + 8
        link = page.offset + 2 + 12 * len(page.tags)
        start = earlier.offset
    position, value = {
        "pixels outside": (place, path.stat().st_size - 8),
        "no pixels": (place, 0),
        "next outside": (link, path.stat().st_size + 400),
        "circle": (link, start),
    }[change]
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, position, value)
    path.write_bytes(data)
    with pytest.raises(DataError, match=complaint):
        open_tiff(path)
