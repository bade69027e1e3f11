"""The same counts in another file are the same movie, with a folder of the file's name."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
from tiff_files import movie

import iscat_analysis as ia
from iscat_cli import main

COUNTS = movie(12, 30, 21)


def test_every_file_is_the_same_movie(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    np.save(tmp_path / "a.npy", COUNTS)
    (tmp_path / "b.bin").write_bytes(COUNTS.tobytes())
    with h5py.File(tmp_path / "c.h5", "w") as file:
        file["run/movie"] = COUNTS
    written: list[str] = []

    def fit_stack(path: Path, _: object, *, out: Path, **__: Any) -> Any:
        with ia.open_stack(path) as stack:
            np.testing.assert_array_equal(stack.read(0, len(COUNTS)), COUNTS)
        written.append(out.name)
        raise ia.DataError("that is enough")

    stand_in = SimpleNamespace(fit_stack=fit_stack)
    monkeypatch.setitem(sys.modules, "iscat_analysis.pipeline", stand_in)
    raw = ["--raw", f"30x21,{COUNTS.dtype}"]
    for name, options in (("a.npy", []), ("b.bin", raw), ("c.h5::/run/movie", [])):
        assert main(["fit", f"{tmp_path / name}", *options]) == 1
    assert written == ["a.iscat", "b.iscat", "c.run.movie.iscat"]


def test_a_shape_that_does_not_fit_is_one_clear_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "b.bin").write_bytes(COUNTS.tobytes())
    assert main(["fit", str(tmp_path / "b.bin"), "--raw", "100x63,uint16"]) == 1
    error = capsys.readouterr().err.strip()
    assert error.count("\n") == 0
    assert "b.bin" in error
    assert "a multiple of 12600" in error
