"""TIFF headers that repeat another's are taken as read; all others are read."""

from __future__ import annotations

import struct

import numpy as np
import pytest
import tifffile

from iscat_analysis.errors import DataError
from iscat_analysis.movie import open_tiff, tiff


def movie(frames, shape=(6, 7)):
    return np.random.default_rng(3).integers(0, 60000, (frames, *shape), dtype=np.uint16)


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
    counts, path = movie(40), tmp_path / "movie.tif"
    with tifffile.TiffWriter(path, **options) as file:
        for frame in counts:
            file.write(frame, contiguous=False, metadata=None, resolution=(11, 12))
    frames = open_tiff(path)
    assert np.array_equal(frames.read(0, 40), counts)
    assert np.array_equal(frames.read(13, 14), counts[13:14])
    frames.close()
    assert len(read_whole) < 4


def test_an_image_that_differs_is_read_and_judged(tmp_path, read_whole):
    counts, path = movie(20), tmp_path / "movie.tif"
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
    counts, path = movie(20), tmp_path / "movie.tif"
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
