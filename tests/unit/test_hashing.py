"""A movie's file is hashed beside the analysis, once."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
import tifffile

import iscat_analysis as ia
from iscat_analysis.errors import DataError
from iscat_analysis.hashing import sha256_of_files


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
