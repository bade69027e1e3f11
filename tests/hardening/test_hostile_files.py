"""Files made to exhaust, mislead or escape: every one is refused in one line, at small cost."""

from __future__ import annotations

import ast
import json
import struct
import tracemalloc
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import imagecodecs
import numpy as np
import pytest
import tifffile
from hardening.samples import CALIBRATION, EVENTS, write_one_mp, write_two_mp
from tiff_files import ASCII, LONG, SHORT, movie, pages_of, write_tiff

from iscat_analysis.errors import DataError
from iscat_analysis.movie import open_stack
from iscat_analysis.movie.tables import read_events

CAP = 256_000_000  # bytes that refusing a file may allocate
ROOT = Path(__file__).resolve().parents[2]


@contextmanager
def modest() -> Iterator[None]:
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < CAP
    finally:
        tracemalloc.stop()


def refuse(path: Path, match: str, read: Callable[[Path], object] | None = None) -> None:
    def whole(path: Path) -> None:
        with open_stack(path) as stack:
            for _ in stack.chunks(memory_mb=16):
                pass

    with modest(), pytest.raises(DataError, match=match) as caught:
        (read or whole)(path)
    assert "\n" not in str(caught.value)


# ---- XML and JSON --------------------------------------------------------------------------------

BOMB = "".join(f'<!ENTITY a{n + 1} "{f"&a{n};" * 10}">' for n in range(12))
OME = (
    '<?xml version="1.0"?>{}<OME><Image><Pixels SizeT="2" SizeC="1" SizeZ="1">{}'
    "</Pixels></Image></OME>"
)


def tagged(folder: Path, tag: int, text: str) -> Path:
    """Write a movie of two frames, the first of which has a text."""
    tags = {0: {tag: (ASCII, text)}}
    return write_tiff(folder / "m.tif", pages_of(movie(2)), (10, 14), page_tags=tags)


def same(path: Path) -> None:
    """Read such a movie, whose text does not matter."""
    with open_stack(path) as stack:
        np.testing.assert_array_equal(stack.read(0, 2), movie(2))


@pytest.mark.parametrize(
    "document",
    [
        OME.format(f'<!DOCTYPE OME [<!ENTITY a0 "lol">{BOMB}]>', "&a12;"),
        OME.format('<!DOCTYPE OME [<!ENTITY a SYSTEM "file:///etc/hostname">]>', "&a;"),
        OME.format('<!DOCTYPE OME SYSTEM "http://localhost/ome.dtd">', ""),
    ],
    ids=["billion laughs", "external entity", "external DTD"],
)
def test_document_types_are_refused(tmp_path: Path, document: str) -> None:
    refuse(tagged(tmp_path, 270, document), "declares a document type")


def test_deep_xml_neither_overflows_nor_matters(tmp_path: Path) -> None:
    deep = "<a>" * 100_000 + "</a>" * 100_000
    same(tagged(tmp_path, 270, OME.format("", deep)))


@pytest.mark.parametrize("text", ["[" * 100_000, '{"shape": ' + "[" * 100_000, '{"a":' * 50_000])
@pytest.mark.parametrize("tag", [270, 51123])
def test_deep_json_neither_overflows_nor_matters(tmp_path: Path, tag: int, text: str) -> None:
    same(tagged(tmp_path, tag, text))


def test_deep_summary_of_micro_manager(tmp_path: Path) -> None:
    path = tagged(tmp_path, 51123, "{}")
    data = path.read_bytes()
    summary = b"[" * 100_000
    (first,) = struct.unpack_from("<I", data, 4)
    # What Micro-Manager puts before the first image: eight numbers and its summary.
    head = struct.pack("<IIIIIIII", 54773648, 0, 483765892, 0, 99384722, 0, 2355492, len(summary))
    shift = len(head) + len(summary)
    start = data[:4] + struct.pack("<I", first + shift)
    path.write_bytes(_shifted(start, head + summary, data[8:], shift))
    with pytest.raises(RecursionError), path.open("rb") as file:
        tifffile.read_micromanager_metadata(file, {"Summary"})  # the trap is set
    same(path)


def _shifted(start: bytes, inserted: bytes, rest: bytes, shift: int) -> bytes:
    """Put bytes between the header and the images of a classic TIFF file, moving its pointers."""
    body = bytearray(rest)
    position = 0
    while True:
        (count,) = struct.unpack_from("<H", body, position)
        for entry in range(position + 2, position + 2 + 12 * count, 12):
            code, kind, number, value = struct.unpack_from("<HHII", body, entry)
            size = number * {2: 1, 3: 2, 4: 4, 5: 8}[kind]
            if code == 273 or size > 4:
                struct.pack_into("<I", body, entry + 8, value + shift)
        (following,) = struct.unpack_from("<I", body, position + 2 + 12 * count)
        if not following:
            return start + inserted + bytes(body)
        struct.pack_into("<I", body, position + 2 + 12 * count, following + shift)
        position = following - 8


@pytest.mark.parametrize("digits", [21, 5000])
def test_numbers_without_end(tmp_path: Path, digits: int) -> None:
    path = tagged(tmp_path, 270, "ImageJ=1.53\nimages=" + "9" * digits + "\n")
    refuse(path, "describes 9+ frames but holds 2")


# ---- TIFF ----------------------------------------------------------------------------------------


def test_a_frame_that_inflates_without_measure(tmp_path: Path) -> None:
    raw = zlib.compress(bytes(30_000_000))
    tags = {258: (SHORT, [16]), 259: (SHORT, [8])}
    refuse(write_tiff(tmp_path / "m.tif", [raw] * 2, (20_000, 20_000), tags=tags), "would grow")


def test_pixels_that_inflate_beyond_their_frame(tmp_path: Path) -> None:
    raw = zlib.compress(bytes(300_000_000))  # declared: 280 bytes
    path = write_tiff(tmp_path / "m.tif", [raw] * 2, (10, 14), tags={259: (SHORT, [8])})
    refuse(path, "cannot be decompressed")


def test_many_frames_from_one_compressed_frame(tmp_path: Path) -> None:
    raw = zlib.compress(bytes(2 * 5000 * 6000))
    tags = {259: (SHORT, [8])}
    path = write_tiff(tmp_path / "m.tif", [b"\0"] * 4000, (5000, 6000), tags=tags)
    data = bytearray(path.read_bytes())
    place = len(data)
    for position in _directories(data):
        for entry in range(position + 2, position + 2 + 12 * 9, 12):
            (code,) = struct.unpack_from("<H", data, entry)
            if code in (273, 279):
                struct.pack_into("<I", data, entry + 8, place if code == 273 else len(raw))
    path.write_bytes(bytes(data) + raw)
    refuse(path, "would grow")


def _directories(data: bytearray) -> Iterator[int]:
    (position,) = struct.unpack_from("<I", data, 4)
    while position:
        yield position
        (count,) = struct.unpack_from("<H", data, position)
        (position,) = struct.unpack_from("<I", data, position + 2 + 12 * count)


@pytest.mark.parametrize("what", ["strips", "text"])
def test_images_that_share_one_long_list(tmp_path: Path, what: str) -> None:
    """Ten thousand images that each point to the same megabyte."""
    rows = 250_000 if what == "strips" else 4
    pixels = bytes(rows)
    tags = {258: (SHORT, [8])}
    if what == "strips":
        tags |= {278: (LONG, [1]), 273: (LONG, [8] * rows), 279: (LONG, [1] * rows)}
    else:
        tags[270] = (ASCII, json.dumps({"shape": [1]}) + " " * 1_000_000)
    path = write_tiff(tmp_path / "m.tif", [pixels], (rows, 1), tags=tags)
    data = bytearray(path.read_bytes())
    (first,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, first)
    size = 2 + 12 * count + 4
    directory = bytes(data[first : first + size])
    struct.pack_into("<I", data, first + size - 4, len(data))
    for number in range(10_000):
        following = 0 if number == 9999 else len(data) + size
        data += directory[:-4] + struct.pack("<I", following)
    path.write_bytes(bytes(data))
    refuse(path, "overlap")


# ---- HDF5 ----------------------------------------------------------------------------------------


def _movie_with(path: Path, make: Callable[[h5py.File], object]) -> Path:
    with h5py.File(path, "w") as file:
        file["configuration/Devices/AcqCam/FrameRate"] = 100.0
        make(file)
    return path


def test_links_are_not_followed(tmp_path: Path) -> None:
    write_one_mp(tmp_path / "secret.mp", movie())
    for link in (h5py.ExternalLink("secret.mp", "/frame"), h5py.SoftLink("/frame2")):

        def make(file: h5py.File, link: object = link) -> None:
            file["frame2"] = movie()
            file["frame"] = link

        refuse(_movie_with(tmp_path / "m.mp", make), "is a link")


def test_a_linked_group_is_not_followed(tmp_path: Path) -> None:
    write_two_mp(tmp_path / "secret.mp", movie())
    path = tmp_path / "m.mp"
    with h5py.File(path, "w") as file:
        file["movie"] = h5py.ExternalLink("secret.mp", "/movie")
    refuse(path, "is a link")


def test_virtual_and_external_data_are_refused(tmp_path: Path) -> None:
    write_one_mp(tmp_path / "secret.mp", movie())
    layout = h5py.VirtualLayout((6, 10, 14), "u2")
    layout[:] = h5py.VirtualSource(tmp_path / "secret.mp", "frame", (6, 10, 14))
    path = _movie_with(tmp_path / "m.mp", lambda f: f.create_virtual_dataset("frame", layout))
    refuse(path, "lie in other files")
    raw = tmp_path / "raw.bin"
    raw.write_bytes(bytes(10_000))
    external = [(str(raw), 0, 6 * 10 * 14 * 2)]
    path = _movie_with(
        tmp_path / "m.mp", lambda f: f.create_dataset("frame", (6, 10, 14), "u2", external=external)
    )
    refuse(path, "lie in other files")


@pytest.mark.parametrize(
    ("shape", "options"),
    [
        ((2**40, 128, 128), {"chunks": (1, 128, 128)}),
        ((2**20, 2**20, 2**20), {"chunks": (1, 64, 64)}),
        ((10, 2**16, 2**16), {"chunks": (1, 2**15, 2**14)}),
        ((1000, 100, 100), {"chunks": (1, 100, 100)}),
    ],
    ids=["frames", "everything", "chunks", "unwritten"],
)
def test_declared_shapes_need_bytes(tmp_path: Path, shape: tuple[int, ...], options: dict) -> None:
    def make(file: h5py.File) -> None:
        file.create_dataset("frame", shape, "u2", compression="gzip", **options)

    refuse(_movie_with(tmp_path / "m.mp", make), "would grow|incomplete|too large")


def test_chunks_that_inflate_beyond_their_size(tmp_path: Path) -> None:
    bombs = {
        1: zlib.compress(bytes(400_000_000)),
        32015: bytes(imagecodecs.zstd_encode(bytes(400_000_000))),
    }
    for number, raw in bombs.items():

        def make(file: h5py.File, number: int = number, raw: bytes = raw) -> None:
            settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
            settings.set_chunk((1, 10, 14))
            settings.set_filter(number, h5py.h5z.FLAG_OPTIONAL, (6,) if number == 1 else ())
            space = h5py.h5s.create_simple((2, 10, 14))
            kind = h5py.h5t.py_create(np.dtype("u2"))
            frame = h5py.h5d.create(file.id, b"frame", kind, space, settings)
            for place in range(2):
                frame.write_direct_chunk((place, 0, 0), raw)

        path = _movie_with(tmp_path / "m.mp", make)
        refuse(path, "cannot be decompressed")


def test_objects_are_never_read_as_numbers(tmp_path: Path) -> None:
    def make(file: h5py.File) -> None:
        file.create_dataset("frame", (2, 3, 4), h5py.string_dtype())

    refuse(_movie_with(tmp_path / "m.mp", make), "not an array of integers or floats")
    path = tmp_path / "events.h5"
    with h5py.File(path, "w") as file:
        for name in EVENTS:
            file[name] = [b"1"] * 3
        file["mass_model/c_1kDa"], file["mass_model/o_0kDa"] = CALIBRATION
    refuse(path, "not an array of integers or floats", read_events)


def test_unknown_filters_are_named(tmp_path: Path) -> None:
    path = _movie_with(
        tmp_path / "m.mp",
        lambda f: f.create_dataset("frame", data=movie(), chunks=True, fletcher32=True),
    )
    refuse(path, "HDF5 filter 3, which is not supported")


def test_a_recording_that_stopped_early_is_refused(tmp_path: Path) -> None:
    def make(file: h5py.File) -> None:
        frame = file.create_dataset("frame", (6, 10, 14), "u2", chunks=(1, 10, 14))
        frame[:4] = movie(4)

    refuse(_movie_with(tmp_path / "m.mp", make), "incomplete")


# ---- tables --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "lacks the columns contrasts and masses_kDa"),
        ("a,b\n1,2\n", "lacks the column"),
        ("\0" * 100, "neither an HDF5 file nor a text file"),
        ("frame_indices,x_coords,y_coords,contrasts\n1,2,3\n", "row 0 has 3 values"),
        ("frame_indices,x_coords,y_coords,contrasts\n1,2,3,__import__('os')\n", "no number"),
        ("frame_indices,x_coords,y_coords,contrasts\n1e17,2,3,4\n", "no frame number"),
        ("frame_indices,x_coords,y_coords,contrasts\n-1,2,3,4\n", "no frame number"),
        ("frame_indices,x_coords,y_coords,contrasts\n1,2,3," + "9" * 200_000, "as a table"),
        ('frame_indices,x_coords,y_coords,contrasts\n1,2,3,"4\n5', "as a table|row 0"),
    ],
)
def test_tables_that_are_not(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "events.csv"
    path.write_text(text)
    refuse(path, message, read_events)


def test_records_that_are_not_numbers(tmp_path: Path) -> None:
    plain = [("frame", "u4"), ("mass_kda", "f4")]
    for kinds, message in (
        ([*plain, ("name", "S5")], "not an array of integers or floats"),
        ([*plain, ("pair", "f4", 2)], "not an array of integers or floats"),
        ([*plain, ("more", plain)], "not an array of integers or floats"),
    ):
        path = tmp_path / "locs.hdf5"
        with h5py.File(path, "w") as file:
            file["locs"] = np.zeros(20, kinds)
        refuse(path, message, read_events)
    with h5py.File(path, "w") as file:
        file.create_dataset("locs", (20,), plain)  # nothing was written
    refuse(path, "incomplete", read_events)
    refuse(
        _movie_with(tmp_path / "m.mp", lambda f: f.create_dataset("frame", (6, 10, 14), plain)),
        "not an array of integers or floats",
    )


def test_bytes_that_are_not_text(tmp_path: Path) -> None:
    path = tmp_path / "events.csv"
    path.write_bytes(b"\xff\xfe\x00\x01" * 10)
    refuse(path, "neither an HDF5 file nor a text file", read_events)


# ---- pickles -------------------------------------------------------------------------------------


def test_nothing_that_is_read_can_run_code() -> None:
    """No pickle, no evaluation, no YAML: looked for in the syntax tree of every source.

    Jobs go to a cluster and come back as pickles, as all that Dask sends: that is no file, and
    whoever is at such a cluster runs code there anyway.  Compiled kernels are pickles of machine
    code, as Numba makes them: they run whoever reads them, and lie in the user's own cache.
    """
    piped = ("executors.py", "study/estimator_process.py", "_kernels/kept.py")
    sent = {ROOT / "iscat_analysis" / name for name in piped}
    forbidden_imports = {"pickle", "cPickle", "dill", "joblib", "shelve", "marshal", "yaml"}
    forbidden_calls = {"eval", "exec", "read_pickle", "to_pickle"}
    offenders: list[tuple[Path, int]] = []
    for path in [*(ROOT / "iscat_analysis").rglob("*.py"), *(ROOT / "cli").rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            bad = False
            if isinstance(node, ast.Import):
                names = {alias.name.split(".")[0] for alias in node.names}
                bad = bool((names - ({"pickle"} if path in sent else set())) & forbidden_imports)
            elif isinstance(node, ast.ImportFrom):
                bad = (node.module or "").split(".")[0] in forbidden_imports
            elif isinstance(node, ast.Call):
                last = getattr(node.func, "attr", getattr(node.func, "id", ""))
                name = ast.unparse(node.func) if last == "load" else last
                allowed = [word for word in node.keywords if word.arg == "allow_pickle"]
                said = [ast.unparse(word.value) for word in allowed]
                bad = last in forbidden_calls or name == "pickle.load"
                bad = bad or (name in ("np.load", "numpy.load") and said != ["False"])
                bad = bad or said not in ([], ["False"])
            offenders += [(path, node.lineno)] if bad else []
    assert offenders == []


def test_a_pickle_is_not_a_movie_nor_a_table(tmp_path: Path) -> None:
    path = tmp_path / "movie.npy"
    np.save(path, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    refuse(path, "is object of shape")
    refuse(path, "neither an HDF5 file nor a text file", read_events)


def test_a_map_that_is_a_movie_of_colours_is_refused(tmp_path: Path) -> None:
    from iscat_analysis.camera import read_map

    tifffile.imwrite(tmp_path / "map.tif", np.zeros((10, 14, 3), "u1"), photometric="rgb")
    refuse(
        tmp_path / "map.tif", "map of", lambda path: read_map(path, "camera.offset_adu", (10, 14))
    )
