"""A movie's file is hashed beside the analysis, once."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
import tifffile

import iscat_analysis as ia
from iscat_analysis.errors import DataError
from iscat_analysis.files import sha256_of_files
from iscat_analysis.movie import formats


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "movie.tif"
    tifffile.imwrite(path, np.arange(2560, dtype=np.uint16).reshape(5, 16, 32))
    return path


def test_a_file_is_hashed_once_as_anybody_would(file: Path) -> None:
    with ia.open_stack(file) as movie:
        hashed = movie.hashed()
        assert movie.hashed() is hashed
        assert hashed.result() == hashlib.sha256(file.read_bytes()).hexdigest()


def test_several_files_and_a_part_of_them(file: Path, tmp_path: Path) -> None:
    other = tmp_path / "more.tif"
    other.write_bytes(b"more")
    expected = hashlib.sha256(file.read_bytes() + b"more" + "dataset µ".encode()).hexdigest()
    assert sha256_of_files((file, other), "dataset µ") == expected


def test_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot be read"):
        sha256_of_files((tmp_path / "gone.tif",))


def test_a_movie_that_was_removed_has_no_identity(file: Path) -> None:
    with ia.open_stack(file) as movie:
        file.unlink()
        with pytest.raises(DataError, match=r"movie\.tif: can no longer be read"):
            _ = movie.identity


def test_a_movie_that_was_replaced_while_it_was_open_is_refused(file: Path, tmp_path: Path) -> None:
    """Its frames are of the file that was opened, and the hash is of the other."""
    other = tmp_path / "other.tif"
    tifffile.imwrite(other, np.ones((5, 16, 32), dtype=np.uint16))
    with ia.open_stack(file) as movie:
        before = movie.sha256()
        other.replace(file)
        with pytest.raises(DataError, match=r"movie\.tif: was replaced or written to while"):
            movie.sha256()
        with pytest.raises(DataError, match="was replaced"):
            movie.without(np.zeros((16, 32), bool), np.zeros(0)).hashed().result()
    with ia.open_stack(file) as movie:  # from the beginning it is another movie
        assert movie.sha256() not in ("", before)


def test_a_movie_that_is_replaced_while_it_is_being_opened_is_refused(
    file: Path, tmp_path: Path, monkeypatch
) -> None:
    other = tmp_path / "other.tif"
    tifffile.imwrite(other, np.ones((5, 16, 32), dtype=np.uint16))
    tiff, *others = formats.FORMATS

    def late(path: Path, part: str) -> object:
        frames = tiff.open(path, part)
        other.replace(path)
        return frames

    monkeypatch.setattr(formats, "FORMATS", (tiff._replace(open=late), *others))
    with pytest.raises(DataError, match="was replaced"):
        ia.open_stack(file)
