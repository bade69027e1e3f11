"""Work on a Dask cluster of several processes, one of which is killed at it."""

from __future__ import annotations

import json
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import combinations
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np
import pytest
from cluster_worker import busy, serve
from distributed import Client, Future
from forks import fork
from small_movies import SETUP

import iscat_analysis as ia
from iscat_analysis import executors as places
from iscat_analysis.errors import SchedulerError
from iscat_analysis.fitting.run import partial_folder
from iscat_analysis.pipeline import fit_stack
from iscat_analysis.search import chunks as planning
from iscat_cli import main_fit

pytestmark = [pytest.mark.skipif(os.name == "nt", reason="stops processes by signals")]

DEADLINE_S = 120.0

FRAMES = 720
LANDING = {
    "camera.pixel_size_nm": 84.0,
    "camera.gain_e_per_adu": 4.0,
    "optics.calibrate": "never",
    "particle.mass_kda": 146.0,
    "calibration.gradient_per_kda": -3.1e-5,
    "background.window_frames": 20,
    "compute.memory_limit_mb": 64,
    "simulation.shape": [88, 88],
    "simulation.frames": FRAMES,
    "simulation.photons_per_pixel": 2e5,
    "simulation.count": 8,
    "simulation.leavings": 2,
    "simulation.species": [480.0],
}
NAMES = ("a", "b")


@pytest.fixture(scope="module", autouse=True)
def small_chunks() -> Iterator[None]:
    """Divide this small movie as one of ten times as many pixels."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planning, "MEMORY_SHARE", 0.14)
        yield


class Workers:
    """A scheduler and workers, each a process of its own."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.file = folder / "scheduler.json"
        self._running: list[BaseProcess] = []
        self._start("scheduler", "--port", "0", "--host", "127.0.0.1")
        wait_until(self.file.is_file)
        self.client = Client(json.loads(self.file.read_text())["address"], set_as_default=False)

    def _start(self, kind: str, *options: str) -> None:
        given = ["--scheduler-file", str(self.file), "--no-dashboard", *options]
        log = self._folder / f"{len(self._running)}.log"
        self._running.append(fork(serve, kind, given, folder=self._folder, out=log, err=log))

    def add(self, count: int) -> None:
        """Have so many workers or more."""
        for _ in range(count - len(self.client.nthreads())):
            self._start("worker", "--nthreads", "2", "--no-nanny", "--preload", "cluster_worker")
        wait_until(lambda: len(self.client.nthreads()) >= count)

    def kill_one_at_work(self) -> str:
        """Kill a worker that is in the middle of a job: stopped first, so that it stays there."""
        pids = self.client.run(os.getpid)
        while True:
            time.sleep(0.01)
            for address, keys in self.client.processing().items():
                if not keys:
                    continue
                os.kill(pids[address], signal.SIGSTOP)
                time.sleep(0.2)  # for what it has sent already
                if self.client.processing().get(address):
                    os.kill(pids[address], signal.SIGKILL)
                    return str(address)
                os.kill(pids[address], signal.SIGCONT)

    def idle(self) -> bool:
        """Whether nothing is left to do."""
        return not any(self.client.processing().values())

    def close(self) -> None:
        """End every process."""
        self.client.close()
        for process in reversed(self._running):
            process.kill()
            process.join()


def wait_until(condition: Callable[[], bool]) -> None:
    """Wait for something that must come to be."""
    due = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < due, "waited in vain"
        time.sleep(0.05)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory) -> Iterator[Workers]:
    """Start a scheduler; tests add the workers that they need."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(places, "CONNECT_S", DEADLINE_S)  # other tests keep the machine busy
        workers = Workers(tmp_path_factory.mktemp("cluster"))
        try:
            yield workers
        finally:
            workers.close()


@contextmanager
def one_killed(cluster: Workers) -> Iterator[list[str]]:
    """Kill a worker as soon as it works, and give its address."""
    killed: list[str] = []
    thread = threading.Thread(target=lambda: killed.append(cluster.kill_one_at_work()), daemon=True)
    thread.start()
    yield killed
    thread.join(DEADLINE_S)
    assert killed
    assert killed[0] not in cluster.client.nthreads()


def _content(folder: Path) -> dict[str, bytes]:
    """Give the bytes of every file, without times and the command."""
    found = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file() and ".batch" not in p.parts):
        data = path.read_bytes()
        if path.name == "summary.json":
            summary = json.loads(data)
            del summary["seconds"]
            data = json.dumps(summary).encode()
        if path.name == "report.html":
            data = re.sub(rb"\d{4}-\d\d-\d\dT[\d:+]+|\d+ \w+ \d{4}, \d\d:\d\d UTC", b"", data)
        found[path.relative_to(folder).as_posix()] = data
    return found


# ---- chunks of a movie -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def landing(tmp_path_factory) -> Path:
    """Simulate a landing movie of several chunks."""
    path = tmp_path_factory.mktemp("landing") / "movie.tif"
    ia.simulate_movie(LANDING, path, seed=4)
    return path


@pytest.fixture(scope="module")
def here(landing: Path) -> Path:
    """Analyse it in this process."""
    folder = landing.with_name("here.iscat")
    analysis = fit_stack(landing, ia.configure(LANDING), out=folder, command="iscat-fit")
    assert analysis.summary["landing"]["chunks"] >= 3
    assert len(analysis.table) >= 8
    return folder


@contextmanager
def bytes_sent(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, int]]:
    """Count what goes to the workers, and what comes back."""
    counted = {"there": 0, "back": 0}
    submit, result = Client.submit, Future.result

    def submitting(self: Client, *arguments: object, **options: object) -> Future:
        counted["there"] += sum(len(each) for each in arguments if isinstance(each, bytes))
        return submit(self, *arguments, **options)

    def receiving(self: Future, *arguments: object) -> bytes:
        found = result(self, *arguments)
        counted["back"] += len(found)
        return found

    with monkeypatch.context() as patch:
        patch.setattr(Client, "submit", submitting)
        patch.setattr(Future, "result", receiving)
        yield counted


def test_chunks_of_a_movie_give_the_same_bytes_when_a_worker_is_killed(
    cluster: Workers, landing: Path, here: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Workers read the movie themselves; only what they find travels."""
    cluster.add(2)
    out, config, told = tmp_path / "far.iscat", ia.configure(LANDING), []
    with (
        one_killed(cluster),
        bytes_sent(monkeypatch) as counted,
        places.open_executor(scheduler_file=cluster.file) as executor,
    ):
        fit_stack(
            landing, config, out=out, command="iscat-fit", executor=executor,
            progress=lambda *step: told.append(step),
        )  # fmt: skip
    assert 0 < counted["there"] < 0.002 * landing.stat().st_size
    assert 0 < counted["back"] < 0.1 * landing.stat().st_size
    chunks = json.loads((here / "summary.json").read_text())["landing"]["chunks"]
    assert [total for stage, _, total in told if stage == "landing"] == chunks * [FRAMES]
    assert told[-1] == ("landing", FRAMES, FRAMES)
    assert _content(out) == _content(here)


@pytest.mark.large
def test_tiles_of_a_field_give_the_same_bytes(
    cluster: Workers, landing: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two tiles of each of two chunks are jobs; the sums over the field are made once for both."""
    monkeypatch.setattr(planning, "plan_chunks", lambda *_: 0)
    monkeypatch.setattr(planning, "choose_tiles", lambda *_, **__: ((1, 2), FRAMES // 2))
    cluster.add(2)
    config = ia.configure(LANDING)
    for name, file in (("here", None), ("far", cluster.file)):
        out = tmp_path / f"{name}.iscat"
        with places.open_executor(scheduler_file=file) as executor:
            fit_stack(landing, config, out=out, command="iscat-fit", executor=executor)
    found = json.loads((tmp_path / "far.iscat" / "summary.json").read_text())["landing"]
    assert (found["chunks"], found["tiles"]) == (2, 2)
    assert _content(tmp_path / "far.iscat") == _content(tmp_path / "here.iscat")


@pytest.mark.large
def test_an_interrupt_keeps_finished_chunks_and_leaves_the_cluster_alive(
    cluster: Workers, landing: Path, here: Path, tmp_path: Path
) -> None:
    cluster.add(2)
    out, config = tmp_path / "far.iscat", ia.configure(LANDING)

    def stop(stage: str, done: int, total: int) -> None:
        if stage == "landing" and done < total:
            raise KeyboardInterrupt

    with places.open_executor(scheduler_file=cluster.file) as executor:
        with pytest.raises(KeyboardInterrupt):
            fit_stack(landing, config, out=out, progress=stop, executor=executor)
        with pytest.raises(SchedulerError, match="the work was stopped"):
            executor.call(print)
    assert json.loads((out / "summary.json").read_text())["interrupted"]
    assert list(partial_folder(out).glob("*.npz"))
    wait_until(cluster.idle)
    assert len(cluster.client.nthreads()) == 2
    fit_stack(landing, config, out=out, command="iscat-fit")  # goes on in this process
    assert not partial_folder(out).exists()
    assert _content(out) == _content(here)


@pytest.mark.large
def test_posteriors_are_those_of_one_process(cluster: Workers, landing: Path, monkeypatch) -> None:
    """How many are sampled in a chunk follows from those before it."""
    cluster.add(2)
    monkeypatch.setattr("iscat_analysis.landing.chunks.POSTERIORS", 2)
    monkeypatch.chdir(landing.parent)  # workers run elsewhere
    more = {"posterior.enabled": True, "posterior.steps": 100, "posterior.walkers": 10}
    alone, apart = (
        ia.fit_movie(landing.name, config=LANDING, settings=more, **where)
        for where in ({}, {"scheduler_file": cluster.file})
    )
    sampled = [view.event for view in alone.analysis.views if view.posterior is not None]
    assert len(sampled) == 2
    for one, other in zip(alone.analysis.views, apart.analysis.views, strict=True):
        assert (one.posterior is None) == (other.posterior is None)
        if one.posterior is not None and other.posterior is not None:
            assert np.array_equal(one.posterior.samples, other.posterior.samples)
    assert alone.table.equals(apart.table)


def test_a_worker_does_one_job_at_a_time_with_all_its_threads(cluster: Workers) -> None:
    """Its memory is that of one job, even where others ask it for more at the same time."""
    cluster.add(2)
    with (
        places.open_executor(scheduler_file=cluster.file) as executor,
        ThreadPoolExecutor(5) as pool,
    ):
        done = list(pool.map(lambda _: executor.call(busy, 0.1), range(5)))
    assert {count for _, count, _, _ in done} == {2}
    for one, other in combinations(done, 2):
        apart = one[3] <= other[2] or other[3] <= one[2]
        assert one[0] != other[0] or apart


def test_an_array_is_refused(cluster: Workers) -> None:
    with pytest.raises(ia.ConfigError, match=r"is an array, and workers read a movie from its f"):
        ia.fit_movie(np.ones((40, 64, 64), "u2"), config=LANDING, scheduler_file=cluster.file)


def test_a_movie_without_chunks_is_analysed_here_and_says_so(
    cluster: Workers, tmp_path: Path, capsys
) -> None:
    _simulate(tmp_path / "a.tif", 1)
    (tmp_path / "setup.toml").write_text(ia.config_to_toml(ia.configure(SETUP)))
    command = [str(tmp_path / "a.tif"), "--config", str(tmp_path / "setup.toml")]
    assert main_fit([*command, "--scheduler-file", str(cluster.file)]) == 0
    assert "a.tif: is analysed in this process: only landing movies" in capsys.readouterr().err


def test_a_worker_of_other_versions_is_refused(
    cluster: Workers, landing: Path, monkeypatch
) -> None:
    cluster.add(1)
    ours = places.versions()
    monkeypatch.setattr(places, "versions", lambda: {**ours, "numba": "0.1"})
    with pytest.raises(ia.ConfigError, match=rf"numba {re.escape(ours['numba'])} \(here 0\.1\)"):
        ia.fit_movie(landing, config=LANDING, scheduler_file=cluster.file)


# ---- movies of a day -------------------------------------------------------------------------


def _simulate(path: Path, seed: int) -> None:
    events = [
        {"frame": 30, "x_px": 20.3 + 22 * k, "y_px": 20.8 + 20 * k, "mass_kda": 900.0 + 600 * k}
        for k in (0, 1)
    ]
    ia.simulate_movie({**SETUP, "simulation.events": events}, path, seed=seed)


@pytest.fixture(scope="module")
def day(tmp_path_factory) -> Path:
    """Make a day: two movies, and one that is cut short."""
    folder = tmp_path_factory.mktemp("day")
    for number, name in enumerate(NAMES):
        _simulate(folder / f"{name}.tif", number + 1)
    (folder / "cut.tif").write_bytes((folder / "a.tif").read_bytes()[:9000])
    rows = "".join(f"{name}.tif,{name},{k}\n" for k, name in enumerate((*NAMES, "cut")))
    (folder / "samples.csv").write_text(f"path,sample,concentration_nm\n{rows}")
    return folder


def test_movies_of_a_day_give_the_same_bytes_when_a_worker_is_killed(
    cluster: Workers, day: Path
) -> None:
    """A movie that cannot be analysed says the same, and once."""
    cluster.add(2)
    given = {"config": SETUP, "command": "iscat batch"}
    expected = ia.batch(day / "samples.csv", out=day / "here", **given)
    told: list[str] = []
    with one_killed(cluster):
        found = ia.batch(
            day / "samples.csv", out=day / "far",
            scheduler_file=cluster.file, notify=told.append, **given,
        )  # fmt: skip
    assert sum("cut.tif: is damaged" in line for line in told) == 1
    assert set(found.analysed) == {*NAMES, "cut"}
    assert found.failed == expected.failed
    assert _content(day / "far") == _content(day / "here")
    records = [day / which / ".batch" / "movies" for which in ("here", "far")]
    for name in NAMES:
        ours, theirs = (json.loads((r / f"{name}.json").read_text()) for r in records)
        for record in (ours, theirs):  # the hash of a summary, which has times
            del record["results"]["summary.json"]
        assert ours == theirs


def test_a_worker_that_does_not_see_a_movie_says_which(
    cluster: Workers, day: Path, monkeypatch
) -> None:
    """What the command sees of the file is not what the worker sees of it."""
    cluster.add(1)
    monkeypatch.setattr("iscat_analysis.day.jobs.seen", lambda path: f"another {path}")
    (day / "one.csv").write_text("path\na.tif\n")
    found = ia.batch(day / "one.csv", out=day / "blind", config=SETUP, scheduler_file=cluster.file)
    ((name, why),) = found.failed
    assert name == "a"
    assert f"{day / 'a.tif'}: is not on " in why
    assert "must share the file system" in why
