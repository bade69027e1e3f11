"""Files of Nikon and Zeiss, through packages of the field, or what stands in for them."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from microscope_files import StandInForCzi, StandInForNd2, write_nd2
from small_files import refused

from iscat_analysis.errors import DataError
from iscat_analysis.movie import open_stack

COUNTS = np.random.default_rng(1).integers(1, 60000, (7, 6, 5)).astype(np.uint16)
TIMES_MS = [40 + 5.0 * k for k in range(7)]
ND2, CZI = b"\xda\xce\xbe\x0a", b"ZISRAWFILE"


def _open(path: Path, reader: Any, monkeypatch: pytest.MonkeyPatch, end: bytes = b"whole") -> Any:
    path.write_bytes((ND2 if path.suffix == ".nd2" else CZI) + b"\0" * 20 + end)
    monkeypatch.setitem(sys.modules, reader.__name__, reader)
    if "." in reader.__name__:
        monkeypatch.setitem(sys.modules, reader.__name__.partition(".")[0], reader)
    return open_stack(path)


def _refused(path: Path, reader: Any, monkeypatch: pytest.MonkeyPatch, *said: str) -> None:
    with pytest.raises(DataError) as told, _open(path, reader, monkeypatch) as stack:
        stack.read(0, stack.shape[0])
    assert all(part in str(told.value) for part in said), str(told.value)
    assert "\n" not in str(told.value)
    assert reader.closed


@pytest.mark.parametrize("kind", ["nd2", "czi"])
def test_reads_frames_and_metadata(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    reader = StandInForNd2(COUNTS, TIMES_MS) if kind == "nd2" else StandInForCzi(COUNTS)
    with _open(tmp_path / f"m.{kind}", reader, monkeypatch) as stack:
        assert (stack.shape, stack.dtype) == (COUNTS.shape, COUNTS.dtype)
        np.testing.assert_array_equal(stack.read(0, 7), COUNTS)
        np.testing.assert_array_equal(stack.read(2, 5), COUNTS[2:5])
        found = stack.metadata
        assert (found.source, found.na, found.magnification) == (kind, 1.42, 60)
        assert found.pixel_size_nm == pytest.approx(84.4)
        assert found.frame_rate_hz == pytest.approx(200)
    assert reader.closed


def test_frames_that_nikon_dropped_are_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    times = [40 + 5.0 * k for k in (0, 1, 2, 5, 6, 7, 8)]
    with _open(tmp_path / "m.nd2", StandInForNd2(COUNTS, times), monkeypatch) as stack:
        assert stack.metadata.ticks == (0, 1, 2, 5, 6, 7, 8)


def test_metadata_that_a_package_cannot_read_are_done_without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Silent(StandInForNd2):
        def voxel_size(self) -> Any:
            raise UnboundLocalError("excitation")

    readers = Silent(COUNTS, TIMES_MS), StandInForCzi(COUNTS, metadata={"ImageDocument": None})
    for kind, reader in zip(("nd2", "czi"), readers, strict=True):
        with _open(tmp_path / f"m.{kind}", reader, monkeypatch) as stack:
            assert stack.metadata.pixel_size_nm is None
            np.testing.assert_array_equal(stack.read(0, 7), COUNTS)


def test_what_is_no_movie_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nd2, czi = tmp_path / "m.nd2", tmp_path / "m.czi"
    channels = StandInForNd2(COUNTS, TIMES_MS, sizes={"T": 7, "C": 2, "Y": 6, "X": 5})
    _refused(nd2, channels, monkeypatch, "T (time) of length 7 and C (channel) of length 2")
    boxes = {"T": (0, 1), "Z": (0, 7), "C": (0, 1), "X": (0, 5), "Y": (0, 6)}
    heights = StandInForCzi(COUNTS, total_bounding_box=boxes)
    _refused(czi, heights, monkeypatch, "stack of heights")
    scenes = StandInForCzi(COUNTS, scenes_bounding_rectangle={0: None, 1: None})
    _refused(czi, scenes, monkeypatch, "scene of length 2")
    _refused(czi, StandInForCzi(COUNTS, pixel_types={0: "Bgr24"}), monkeypatch, "Bgr24")
    single = StandInForNd2(COUNTS, TIMES_MS, sizes={"Y": 6, "X": 5})
    _refused(nd2, single, monkeypatch, "holds 1 frame of 6 x 5")
    huge = StandInForNd2(COUNTS, TIMES_MS, sizes={"T": 7, "Y": 10**5, "X": 10**5})
    _refused(nd2, huge, monkeypatch, "would grow from")


def test_frames_that_were_not_written_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    empty = COUNTS.copy()
    empty[4] = 0
    for kind, reader in (("nd2", StandInForNd2(empty, TIMES_MS)), ("czi", StandInForCzi(empty))):
        _refused(tmp_path / f"m.{kind}", reader, monkeypatch, "frame 4 holds nothing but zeros")
    planned = StandInForNd2(COUNTS, TIMES_MS, sizes={"T": 9, "Y": 6, "X": 5})
    _refused(tmp_path / "m.nd2", planned, monkeypatch, "describes 9 frames but holds 7")
    for kind, reader in (("nd2", StandInForNd2(COUNTS, TIMES_MS)), ("czi", StandInForCzi(COUNTS))):
        with pytest.raises(DataError, match=r"or damaged \([^\n]*\); copy it again"):
            _open(tmp_path / f"m.{kind}", reader, monkeypatch, end=b"cut")


def test_the_package_that_is_needed_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for kind, package in (("nd2", "nd2"), ("czi", "pylibCZIrw")):
        monkeypatch.setitem(sys.modules, package, None)
        (tmp_path / f"m.{kind}").write_bytes((ND2 if kind == "nd2" else CZI) + bytes(20))
        with pytest.raises(DataError, match=rf"{package}, .*pip install .*\[{kind}\]"):
            open_stack(tmp_path / f"m.{kind}")


# ---- with the packages themselves, where they are installed --------------------------------------


def test_nd2_reads_what_nikon_writes(tmp_path: Path) -> None:
    pytest.importorskip("nd2")
    with open_stack(write_nd2(tmp_path / "m.nd2", COUNTS, TIMES_MS)) as stack:
        np.testing.assert_array_equal(stack.read(0, 7), COUNTS)
        found = stack.metadata
        assert (found.na, found.magnification) == (1.42, 60)
        assert found.pixel_size_nm == pytest.approx(84.4)
        assert found.frame_rate_hz == pytest.approx(200)
    late = [40 + 5.0 * k for k in (0, 1, 2, 5, 6, 7, 8)]
    with open_stack(write_nd2(tmp_path / "m.nd2", COUNTS, late)) as stack:
        assert stack.metadata.ticks == (0, 1, 2, 5, 6, 7, 8)
    path = write_nd2(tmp_path / "m.nd2", COUNTS, TIMES_MS, lost=[4])
    with open_stack(path) as stack, pytest.raises(DataError, match="frame 4 holds nothing but"):
        stack.read(0, 7)
    path.write_bytes(path.read_bytes()[:-60])
    refused(path, "no ND2 file, or damaged")


def test_pylibczirw_reads_what_zeiss_writes(tmp_path: Path) -> None:
    czi = pytest.importorskip("pylibCZIrw.czi")
    path = tmp_path / "m.czi"
    with czi.create_czi(str(path)) as file:
        for number, frame in enumerate(COUNTS):
            file.write(data=frame[..., None], plane={"T": number, "C": 0, "Z": 0})
        file.write_metadata("m", scale_x=84.4e-9, scale_y=84.4e-9)
    with open_stack(path) as stack:
        np.testing.assert_array_equal(stack.read(0, 7), COUNTS)
        assert stack.metadata.pixel_size_nm == pytest.approx(84.4)
    path.write_bytes(path.read_bytes()[:5000])
    refused(path, "no CZI file, or damaged")
