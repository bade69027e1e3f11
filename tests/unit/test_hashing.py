"""A movie's file is hashed in a process of its own, and its hash is used for nothing else."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile

import iscat_analysis as ia
from iscat_analysis import hashing
from iscat_analysis.copies import Copy, LostError
from iscat_analysis.errors import DataError
from iscat_analysis.hashing import BegunHash, sha256_of_files


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "movie.tif"
    tifffile.imwrite(path, np.arange(2560, dtype=np.uint16).reshape(5, 16, 32))
    return path


def test_a_file_is_hashed_as_anybody_would(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Copy] = []

    class Noted(Copy):
        def __init__(self, work: Callable[..., object]) -> None:
            super().__init__(work)
            made.append(self)

    monkeypatch.setattr(hashing, "Copy", Noted)
    begun = BegunHash(file)
    assert begun.digest.result() == hashlib.sha256(file.read_bytes()).hexdigest()
    assert len(made) == 1
    with pytest.raises(ProcessLookupError):
        os.kill(made[0].pid, 0)


def test_one_that_is_given_up_is_gone(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hashing, "sha256_of_files", lambda _: time.sleep(60))
    begun = BegunHash(file)
    begun.close()
    with pytest.raises(LostError):
        begun.digest.result()
    begun.close()


def test_several_files_and_a_part_of_them(file: Path, tmp_path: Path) -> None:
    other = tmp_path / "more.tif"
    other.write_bytes(b"more")
    expected = hashlib.sha256(file.read_bytes() + b"more" + "dataset µ".encode()).hexdigest()
    assert sha256_of_files((file, other), "dataset µ") == expected


def _no_room(_work: Callable[..., object]) -> Copy:
    raise BlockingIOError(11, "no room for another process")


def _ends_at_once(_work: Callable[..., object]) -> Copy:
    return Copy(lambda _asked: os._exit(9))


@pytest.mark.parametrize("copy", [_no_room, _ends_at_once])
def test_without_another_process(
    file: Path, copy: Callable[..., Copy], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hashing, "Copy", copy)
    expected = hashlib.sha256(file.read_bytes()).hexdigest()
    assert BegunHash(file).digest.result() == expected


def test_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot be read"):
        BegunHash(tmp_path / "gone.tif").digest.result()


def test_only_a_movie_that_is_all_of_the_file_has_its_hash(file: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.tif"
    tifffile.imwrite(other, np.ones((5, 16, 32), dtype=np.uint16))
    begun, wrong = BegunHash(file), BegunHash(other)
    with ia.open_stack(file) as movie:
        assert movie.hashed(begun) is begun.digest
        assert movie.hashed().result() == movie.sha256()
    with ia.open_stack(file) as movie:
        assert movie.hashed(wrong).result() == movie.sha256() != wrong.digest.result()


def test_a_file_that_was_replaced_since_then_is_hashed_again(file: Path, tmp_path: Path) -> None:
    begun, other = BegunHash(file), tmp_path / "other.tif"
    tifffile.imwrite(other, np.ones((5, 16, 32), dtype=np.uint16))
    expected = hashlib.sha256(other.read_bytes()).hexdigest()
    begun.digest.result()
    other.replace(file)
    with ia.open_stack(file) as movie:
        assert movie.hashed(begun).result() == expected


def test_a_movie_that_was_removed_has_no_identity(file: Path) -> None:
    with ia.open_stack(file) as movie:
        file.unlink()
        with pytest.raises(DataError, match=r"movie\.tif: can no longer be read"):
            _ = movie.identity
