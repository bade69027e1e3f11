"""A movie that is analysed while it is being recorded: the result is that of the finished file."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
import tifffile
import zarr
from small_movies import LANDING

from iscat_analysis.config import Config, configure
from iscat_analysis.day import watch as growing
from iscat_analysis.day.watch import RESTS, histogram, watch_movie
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.movie import open_stack
from iscat_analysis.pipeline import fit_stack
from iscat_analysis.study import Movie

FRAMES, STEP = 240, 60

SWMR = """
import sys, h5py, numpy as np
counts = np.load(sys.argv[2])
with h5py.File(sys.argv[1], "w", libver="latest") as file:
    frames = file.create_dataset(
        "frames", shape=(0, *counts.shape[1:]), maxshape=(None, *counts.shape[1:]),
        chunks=(16, 32, 32), dtype=counts.dtype,
    )
    file.swmr_mode = True
    for stop in range(60, len(counts) + 1, 60):
        sys.stdin.readline()
        frames.resize((stop, *counts.shape[1:]))
        frames[stop - 60 : stop] = counts[stop - 60 : stop]
        frames.flush()
        print("written", flush=True)
    sys.stdin.readline()
"""


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Config:
    """Configure a small landing movie."""
    path = tmp_path_factory.mktemp("setup") / "setup.toml"
    path.write_text(LANDING)
    few = {"simulation.frames": FRAMES, "simulation.count": 3, "optics.calibrate": "never"}
    return configure(path, settings=few)


@pytest.fixture(scope="module")
def counts(config: Config) -> np.ndarray:
    """Draw it once."""
    return np.array(list(Movie(config, 3).frames(1)))


class Recorder:
    """Writes TIFF or Zarr in parts."""

    def __init__(self, kind: str, path: Path, counts: np.ndarray) -> None:
        self._kind, self._path, self._counts, self._written = kind, path, counts, 0

    def more(self) -> bool:
        """Write the next part, and tell whether there was one."""
        start, stop = self._written, self._written + STEP
        if start >= FRAMES:
            return False
        part = self._counts[start:stop]
        if self._kind == "tif":
            for frame in part:
                tifffile.imwrite(
                    self._path, frame, append=start > 0 or frame is not part[0],
                    photometric="minisblack", metadata=None,
                )  # fmt: skip
        elif start == 0:
            array = zarr.create_array(
                self._path,
                shape=(0, *part.shape[1:]),
                chunks=(20, 64, 64),
                shards=(40, 64, 64),
                dtype="u2",
            )
            array.append(part)
        else:
            zarr.open_array(self._path, mode="a").append(part)
        self._written = stop
        return True


class Program:
    """A program that writes an HDF5 file; it closes it and ends after the last part."""

    def __init__(self, path: Path, counts: np.ndarray) -> None:
        np.save(path.with_suffix(".npy"), counts)
        self._process = subprocess.Popen(
            [sys.executable, "-c", SWMR, str(path), str(path.with_suffix(".npy"))],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip

    def more(self) -> bool:
        """Have the next part written, and tell whether there was one."""
        if self._process.returncode is not None:
            return False
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        if self._process.stdout.readline() == "written\n":
            return True
        self._process.communicate()
        assert self._process.returncode == 0
        return False


def _contents(folder: Path) -> dict[str, bytes]:
    """Give the bytes of every file but those that say how long it took and when."""
    files = [file for file in folder.rglob("*") if file.is_file()]
    timed = {"summary.json", "report.html"}
    assert timed <= {file.name for file in files}
    return {file.name: file.read_bytes() for file in files if file.name not in timed}


@pytest.mark.parametrize(
    "kind", [*(pytest.param(kind, marks=pytest.mark.large) for kind in ("tif", "zarr")), "h5"]
)
def test_a_movie_that_grows_ends_as_the_finished_file(
    kind: str, config: Config, counts: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An HDF5 file that is open to write is not finished, however long it rests."""
    path = tmp_path / f"movie.{kind}"
    recorder = Program(path, counts) if kind == "h5" else Recorder(kind, path, counts)
    real, looks = growing._Growing.rests, iter(range(1000))
    pause = range(4, 4 + 2 * RESTS) if kind == "h5" else range(0)

    def growing_at_each_look(self: growing._Growing) -> bool:
        if next(looks) not in pause:
            recorder.more()
        return real(self)

    monkeypatch.setattr(growing._Growing, "rests", growing_at_each_look)
    said: list[str] = []
    watch_movie(path, config, out=tmp_path / "live", interval_s=0.01, notify=said.append)
    lines = [line for line in said if " kDa" in line and "frames: " in line]
    assert [int(line.split()[0]) for line in lines] == [120, 180]
    assert sum("a program has it open to write" in line for line in said) == (kind == "h5")
    fit_stack(path, config, out=tmp_path / "after")
    live, after = (_contents(tmp_path / name) for name in ("live", "after"))
    assert live == after
    assert len(pd.read_csv(tmp_path / "live" / "fits.csv")) == 3


@pytest.mark.parametrize("refused", [False, True])
def test_a_camera_that_goes_on_while_its_movie_is_analysed_is_watched_again(
    refused: bool, config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It had paused for longer than a file rests."""
    path, given, said = tmp_path / "movie.tif", [], []

    def analysed(movie: Path, *_: object, overwrite: bool, **__: object) -> int:
        given.append((movie.stat().st_size, overwrite))
        if len(given) == 1:
            movie.write_bytes(bytes(20))
            if refused:
                raise DataError("was written to while it was open")
        return len(given)

    monkeypatch.setattr(growing, "fit_stack", analysed)
    path.write_bytes(bytes(10))
    out = tmp_path / "out"
    found = watch_movie(path, config, out=out, interval_s=0.001, notify=said.append)
    assert found == 2
    assert given == [(10, False), (20, not refused)]
    assert sum("written to meanwhile" in line for line in said) == 1


def test_a_folder_that_is_taken_is_refused_before_the_recording(
    config: Config, tmp_path: Path
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.txt").write_text("mine")
    with pytest.raises(DataError, match=r"thesis\.txt.* is left alone"):
        watch_movie(tmp_path / "movie.tif", config, out=tmp_path / "out")


@pytest.mark.parametrize(
    ("readers", "shape", "expected"),
    [
        (True, (60, 32, 32), ""),
        (False, (60, 32, 32), "lets nobody read meanwhile"),
        (True, (90, 32, 32), "frames is incomplete (it lists 4 chunks where it needs 6)"),
    ],
)
def test_what_a_writer_left_open_is_said(
    readers: bool, shape: tuple[int, ...], expected: str, tmp_path: Path
) -> None:
    """As of a program that ended without closing its file."""
    path = tmp_path / "movie.h5"
    with h5py.File(tmp_path / "open.h5", "w", libver="latest") as file:
        frames = file.create_dataset(
            "frames", shape=(0, 32, 32), maxshape=(None, 32, 32), chunks=(16, 32, 32), dtype="u2"
        )
        if readers:
            file.swmr_mode = True
        frames.resize((60, 32, 32))
        frames[:] = np.arange(60)[:, None, None]
        frames.resize(shape)
        file.flush()
        shutil.copy(tmp_path / "open.h5", path)
    if expected:
        with pytest.raises(DataError, match=re.escape(expected)):
            open_stack(path)
        return
    with open_stack(path) as movie:
        assert movie.read(59, 60).max() == 59
        assert "the 60 frames are those that were written until now" in " ".join(movie.notes)
    with open_stack(tmp_path / "open.h5") as movie:  # control
        assert "written until now" not in " ".join(movie.notes)


def test_flags_of_older_files_are_not_believed(tmp_path: Path) -> None:
    """Before version 3 of the superblock they may be set in any file."""
    path = tmp_path / "movie.h5"
    with h5py.File(tmp_path / "open.h5", "w", libver=("v108", "v108")) as file:
        file["frames"] = np.ones((60, 32, 32), "u2")
        file.flush()
        shutil.copy(tmp_path / "open.h5", path)
    assert path.read_bytes()[8:12] == b"\x02\x08\x08\x01"
    with open_stack(path) as movie:
        assert movie.read(0, 60).min() == 1


def test_what_is_wrong_with_the_setup_is_not_waited_for(
    config: Config, counts: np.ndarray, tmp_path: Path
) -> None:
    np.save(tmp_path / "movie.npy", counts)
    wrong = configure(config, settings={"calibration.gradient_per_kda": 3.1e-5})
    with pytest.raises(ConfigError, match="wrong sign"):
        watch_movie(tmp_path / "movie.npy", wrong, out=tmp_path / "out", interval_s=0.01)


def test_frames_beyond_those_that_are_left_out_are_waited_for(
    config: Config, counts: np.ndarray, tmp_path: Path
) -> None:
    """What is wrong with the frames that are there may be right with those that come."""
    np.save(tmp_path / "movie.npy", counts[:80])
    excluded = configure(config, settings={"fit.excluded_frames": [[0, 75]]})
    said: list[str] = []
    growing._Growing(tmp_path / "movie.npy", excluded, said.append).analyse_what_is_there()
    (line,) = said
    assert line.startswith("not yet: ")
    assert "fit.excluded_frames leaves no" in line


def test_it_waits_for_a_file_that_is_not_there_yet(config: Config, tmp_path: Path) -> None:
    said: list[str] = []
    assert not growing._Growing(tmp_path / "movie.tif", config, said.append).rests()
    assert "waiting" in said[-1]


def test_masses_are_drawn_in_a_line() -> None:
    table = pd.DataFrame({"mass_kda": [100.0] * 8 + [300.0] * 4 + [900.0], "status": "ok"})
    table.loc[12, "status"] = "poor_fit"
    line = histogram(table)
    assert line.startswith("13 events, 0 ")
    bars = line.split("0 ", 1)[1].rsplit(" ", 2)[0]
    assert bars.count("█") == 1
    assert bars.count("▄") == 1
    assert histogram(table[:0]) == "0 events"
