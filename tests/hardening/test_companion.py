"""The second process of a landing movie: the same result, and gone when it is not wanted."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import iscat_analysis as ia
from iscat_analysis.camera.counts import Camera
from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.landing import companion
from iscat_analysis.landing import find as landing
from iscat_analysis.landing.chunk_work import ChunkSetting
from iscat_analysis.landing.companion import Pair, paired
from iscat_analysis.movie import open_stack
from iscat_analysis.pipeline import analyse
from iscat_analysis.places import Here
from iscat_analysis.study.simulate import write_stack
from iscat_analysis.threads import allotted, is_allotted, threads

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="is made on Linux only")

DEADLINE_S = 60.0
SETTINGS = {
    "camera.pixel_size_nm": 84.0,
    "camera.gain_e_per_adu": 4.0,
    "optics.calibrate": "never",
    "particle.mass_kda": 146.0,
    "calibration.gradient_per_kda": -3.1e-5,
    "background.window_frames": 40,
    "compute.memory_limit_mb": 64,
    "simulation.shape": [96, 96],
    "simulation.frames": 1300,
    "simulation.photons_per_pixel": 1e5,
    "simulation.count": 12,
    "simulation.leavings": 3,
    "simulation.species": [480.0],
}


@pytest.fixture(autouse=True)
def two_processors(monkeypatch) -> None:
    monkeypatch.setattr(companion, "processors", lambda: 2)


@pytest.fixture(scope="module")
def movie(tmp_path_factory) -> Path:
    """Simulate a movie of several chunks."""
    path: Path = tmp_path_factory.mktemp("movie") / "movie.tif"
    write_stack(ia.configure(settings=SETTINGS), path, seed=1)
    return path


def _configured(**compute: int) -> Config:
    settings = SETTINGS | {f"compute.{key}": value for key, value in compute.items()}
    return ia.configure(settings=settings)


def test_two_processes_find_what_one_finds(movie: Path, monkeypatch) -> None:
    here: list[tuple[int, int]] = []
    real = landing.analyse_chunk

    def counted(scene: Any, chunk: Any, core: tuple[int, int], *rest: Any) -> Any:
        here.append(core)
        return real(scene, chunk, core, *rest)

    monkeypatch.setattr(landing, "analyse_chunk", counted)
    found, chunks = [], []
    for workers in (1, 2):
        here.clear()
        with open_stack(movie) as stack:
            found.append(analyse(stack, _configured(workers=workers)))
        chunks.append(len(here))
    one, two = found
    assert chunks[0] == one.summary["landing"]["chunks"] > 2
    assert 0 < chunks[1] < chunks[0]
    assert here[0][0] == 0  # whose frames were summed here for the test of the optics
    assert len(one.table) > 8
    pd.testing.assert_frame_equal(one.table, two.table, check_exact=True)
    for mine, other in zip(one.views, two.views, strict=True):
        assert np.array_equal(mine.residual, other.residual, equal_nan=True)
    said = [{k: v for k, v in a.summary.items() if k != "seconds"} for a in found]
    assert json.dumps(said[0]) == json.dumps(said[1])


def test_frames_that_are_wrong_are_refused_as_by_one_process(movie: Path, tmp_path: Path) -> None:
    with open_stack(movie) as stack:
        counts = stack.read(0, stack.shape[0])
    counts[-20] = np.iinfo(counts.dtype).max
    np.save(tmp_path / "bad.npy", counts)
    said = []
    for workers in (1, 2):
        with open_stack(tmp_path / "bad.npy") as stack, pytest.raises(DataError) as error:
            analyse(stack, _configured(workers=workers))
        said.append(str(error.value))
    assert said[0] == said[1]
    assert "saturated throughout" in said[0]


def test_a_second_process_is_made_only_where_it_has_something_to_do(movie: Path) -> None:
    def setting(frames: Any) -> ChunkSetting:
        return ChunkSetting(frames, Camera(), many, (0, 1300), 10, 40, None, None, None)

    many, here = _configured(workers=2), Here()
    with open_stack(movie) as stack:
        given = setting(stack)
        assert isinstance(paired(here, many, given, 2), Pair)
        assert paired(here, many, given, 1) is here
        assert paired(here, _configured(workers=1), given, 2) is here
        other = Pair(2)
        assert paired(other, many, given, 2) is other
        with allotted(2, lambda: None):
            assert paired(here, many, given, 2) is here
    with open_stack(np.ones((50, 8, 8), "u2")) as stack:
        assert paired(here, many, setting(stack), 2) is here


def test_one_processor_does_not_make_room_for_two(movie: Path, monkeypatch) -> None:
    monkeypatch.setattr(companion, "processors", lambda: 1)
    many, here = _configured(workers=2), Here()
    with open_stack(movie) as stack:
        given = ChunkSetting(stack, Camera(), many, (0, 1300), 10, 40, None, None, None)
        assert paired(here, many, given, 2) is here


def test_what_a_job_raises_is_raised_here() -> None:
    both = Pair(2)

    def work(item: int) -> int:
        if both.distant:
            raise ValueError("no number")
        time.sleep(0.01)
        return item

    with pytest.raises(ValueError, match="no number"):
        for _ in both.each(work, range(10_000)):
            pass


def test_what_a_lost_process_was_at_is_done_here() -> None:
    both, items = Pair(2), range(6)

    def work(item: int) -> int:
        if both.distant:
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(0.2)
        return 2 * item

    assert dict(both.each(work, items)) == {item: 2 * item for item in items}


def test_what_a_process_that_hangs_was_at_is_done_here(monkeypatch) -> None:
    monkeypatch.setattr(companion, "_PATIENCE_S", 0.5)
    both, items = Pair(2), range(4)

    def work(item: int) -> int:
        if both.distant:
            time.sleep(600)
        time.sleep(0.02)
        return 2 * item

    assert dict(both.each(work, items)) == {item: 2 * item for item in items}


def test_where_there_is_no_room_for_a_second_process_one_does_everything(monkeypatch) -> None:
    def full() -> int:
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(os, "fork", full)
    held = set(Path("/proc/self/fd").iterdir())
    assert list(Pair(2).each(lambda item: 2 * item, range(3))) == [(0, 0), (1, 2), (2, 4)]
    assert set(Path("/proc/self/fd").iterdir()) == held


def test_the_second_process_has_half_of_the_threads_and_its_own_movie() -> None:
    both, common = Pair(4), [1]

    def work(_: int) -> tuple[bool, int, bool]:
        if not both.distant:
            time.sleep(1.0)
            return False, 0, True
        return both.call(_seen, common)

    def _seen(given: list[int], *, progress: object) -> tuple[bool, int, bool]:
        del progress
        with threads(16) as pool:
            return is_allotted(), pool._max_workers, given is common

    assert both.threads(4) == 2
    assert not both.distant
    results = [found for _, found in both.each(work, range(4))]
    assert (True, 2, False) in results


def _gone(pid: int) -> bool:
    """Whether a process has ended, or is a zombie that nobody has buried yet."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except OSError:
        return True


def _wait(until: Callable[[], bool]) -> None:
    end = time.monotonic() + DEADLINE_S
    while not until():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_an_interrupt_ends_it_in_the_middle_of_a_job(tmp_path: Path) -> None:
    both, sleeper = Pair(2), tmp_path / "pid"

    def work(item: int) -> int:
        if both.distant:
            signal.raise_signal(signal.SIGINT)  # which it leaves to the first process
            _say(sleeper)
            time.sleep(600)
        return item

    results = both.each(work, range(3))
    next(results)
    _wait(sleeper.exists)
    begun = time.monotonic()
    results.close()
    assert time.monotonic() - begun < DEADLINE_S
    assert _gone(int(sleeper.read_text()))


def _say(path: Path) -> None:
    """Write the number of this process, all at once."""
    path.with_suffix(".new").write_text(str(os.getpid()))
    path.with_suffix(".new").replace(path)


def test_it_ends_with_the_process_that_made_it(tmp_path: Path) -> None:
    sleeper = tmp_path / "pid"
    program = (
        "import sys, time\n"
        "from pathlib import Path\n"
        "sys.path.insert(0, sys.argv[2])\n"
        "from test_companion import _say\n"
        "from iscat_analysis.landing.companion import Pair\n"
        "both = Pair(2)\n"
        "def work(item):\n"
        "    if both.distant: _say(Path(sys.argv[1]))\n"
        "    time.sleep(600)\n"
        "list(both.each(work, range(2)))\n"
    )
    first = subprocess.Popen(
        [sys.executable, "-c", program, str(sleeper), str(Path(__file__).parent)]
    )
    _wait(sleeper.exists)
    pid = int(sleeper.read_text())
    assert not _gone(pid)
    os.kill(first.pid, signal.SIGKILL)
    first.wait()
    _wait(lambda: _gone(pid))
