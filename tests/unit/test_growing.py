"""A movie that is analysed while it is being recorded: the result is that of the finished file."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tifffile
import zarr
from small_movies import LANDING

from iscat_analysis.config import Config, configure
from iscat_analysis.day import growing
from iscat_analysis.day.growing import histogram, watch_movie
from iscat_analysis.errors import ConfigError
from iscat_analysis.movie import open_stack
from iscat_analysis.pipeline import fit_stack
from iscat_analysis.study.simulate import Movie

pytestmark = pytest.mark.usefixtures("all_sketched")

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
    """Writes a movie in parts; `more` writes one and tells whether it did."""

    def __init__(self, kind: str, path: Path, counts: np.ndarray) -> None:
        self._kind, self._path, self._counts, self._written = kind, path, counts, 0

    def more(self) -> bool:
        """Write the next part."""
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
                self._path, shape=(0, *part.shape[1:]), chunks=(20, 64, 64), dtype="u2"
            )
            array.append(part)
        else:
            zarr.open_array(self._path, mode="a").append(part)
        self._written = stop
        return True


@pytest.mark.parametrize("kind", [pytest.param("tif", marks=pytest.mark.large), "zarr"])
def test_a_movie_that_grows_ends_as_the_finished_file(
    kind: str, config: Config, counts: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"movie.{kind}"
    recorder = Recorder(kind, path, counts)
    real = growing._Growing.rests

    def growing_at_each_look(self: growing._Growing) -> bool:
        recorder.more()
        return real(self)

    monkeypatch.setattr(growing._Growing, "rests", growing_at_each_look)
    said: list[str] = []
    watch_movie(path, config, out=tmp_path / "live", interval_s=0.01, notify=said.append)
    lines = [line for line in said if " kDa" in line and "frames: " in line]
    assert [int(line.split()[0]) for line in lines] == [120, 180]
    fit_stack(path, config, out=tmp_path / "after")
    written = [(tmp_path / name / "fits.csv").read_bytes() for name in ("live", "after")]
    assert written[0] == written[1]
    assert len(pd.read_csv(tmp_path / "live" / "fits.csv")) == 3


def test_an_hdf5_file_is_read_while_it_is_written(counts: np.ndarray, tmp_path: Path) -> None:
    """Single writer, many readers: each flush shows more frames."""
    path = tmp_path / "movie.h5"
    np.save(tmp_path / "counts.npy", counts)
    command = [sys.executable, "-c", SWMR, str(path), str(tmp_path / "counts.npy")]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as writer:
        assert writer.stdin is not None
        assert writer.stdout is not None
        for stop in range(STEP, FRAMES + 1, STEP):
            assert writer.stdout.readline() == "written\n"
            with open_stack(path) as movie:
                assert movie.shape[0] == stop
                np.testing.assert_array_equal(movie.read(0, stop), counts[:stop])
            writer.stdin.write("\n")
            writer.stdin.flush()
    assert writer.returncode == 0


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
    stop = threading.Event()
    stop.set()
    with pytest.raises(Exception, match=r"movie\.tif"):
        watch_movie(
            tmp_path / "movie.tif", config, out=tmp_path / "out", stop=stop, notify=said.append
        )
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
