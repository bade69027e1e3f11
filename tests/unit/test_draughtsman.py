"""A report drawn by a process of its own: the same report, and no process that stays."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from iscat_analysis import draughtsman as module
from iscat_analysis.config import load_config
from iscat_analysis.draughtsman import Draughtsman
from iscat_analysis.pipeline import fit_stack
from iscat_analysis.records import Analysis
from iscat_analysis.report import write_report
from iscat_analysis.report.drawing import Drawing
from iscat_analysis.study.simulate import write_stack
from iscat_analysis.threads import processors

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from report_factory import make_analysis

pytestmark = pytest.mark.skipif(processors() == 1, reason="one processor: nothing is started")


@pytest.fixture(scope="module")
def analysis() -> Analysis:
    return make_analysis(3, "joint", posteriors=1)


@pytest.fixture(scope="module")
def expected(analysis: Analysis, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return contents(write_report(analysis, tmp_path_factory.mktemp("here") / "out"))


@pytest.fixture
def pen(monkeypatch: pytest.MonkeyPatch) -> Iterator[Draughtsman]:
    monkeypatch.delitem(sys.modules, "matplotlib")
    with closing(Draughtsman()) as begun:
        begun.start()
        monkeypatch.undo()
        yield begun


def contents(folder: Path) -> dict[str, bytes]:
    files = [file for file in sorted(folder.rglob("*")) if file.is_file()]
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


def wait_until_gone(kill: Callable[[int, int], None], number: int) -> None:
    """Wait for the end of a process or group that is no child: the system collects it."""
    with suppress(ProcessLookupError):
        while True:
            kill(number, 0)
            time.sleep(0.01)


def test_it_draws_the_same_report(
    pen: Draughtsman, analysis: Analysis, expected: dict[str, bytes], tmp_path: Path
) -> None:
    pictures = tmp_path / "figures"
    pictures.mkdir()
    known = {"distribution": None, "across_particles": []}
    pen.begin(replace(analysis, summary={**analysis.summary, **known}), pictures, 12)
    pen.begin(analysis, tmp_path / "nowhere", 12)  # which it does once
    pen.end(analysis.summary)
    page = pen.page()
    assert page is not None
    drawn = {name for name in expected if name.startswith("figures")}
    assert len(drawn) > 8
    assert contents(tmp_path) == {name: expected[name] for name in drawn}
    assert page.encode() == expected["report.html"]


def test_a_report_is_written_with_it(
    pen: Draughtsman,
    analysis: Analysis,
    expected: dict[str, bytes],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("iscat_analysis.report.drawing.Drawing", None)  # nothing is drawn here
    assert contents(write_report(analysis, tmp_path / "out", draughtsman=pen)) == expected


@pytest.mark.parametrize("when", ["before", "while it draws"])
def test_where_it_fails_the_report_is_drawn_here(
    pen: Draughtsman,
    when: str,
    analysis: Analysis,
    expected: dict[str, bytes],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    end = pen._other.end
    if when == "before":
        end()
    else:
        monkeypatch.setattr("iscat_analysis.report.write_tables", lambda *_: end())
    found = contents(write_report(analysis, tmp_path / "out", draughtsman=pen))
    tables = {name for name in expected if name.partition(".")[0] in ("fits", "summary", "config")}
    assert found == {k: v for k, v in expected.items() if when == "before" or k not in tables}


def test_it_ends_with_its_copy_whatever_they_are_at(
    pen: Draughtsman, analysis: Analysis, tmp_path: Path
) -> None:
    pen.begin(analysis, tmp_path, 12)
    while not any(tmp_path.iterdir()):  # until it draws
        time.sleep(0.01)
    pen.close()
    assert pen.page() is None
    wait_until_gone(os.killpg, pen._other.pid)


def test_it_ends_when_the_command_is_killed(tmp_path: Path) -> None:
    text = (
        "import sys, time; from contextlib import closing\n"
        "from iscat_analysis.draughtsman import Draughtsman\n"
        "with closing(Draughtsman()) as pen:\n"
        "    pen.start(); print(pen._other.pid, flush=True); time.sleep(60)"
    )
    command = [sys.executable, "-c", text]
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=tmp_path) as process:
        assert process.stdout is not None
        pid = int(process.stdout.readline())
        process.kill()
    wait_until_gone(os.kill, pid)


def test_a_process_that_has_matplotlib_draws_itself() -> None:
    assert "matplotlib" in sys.modules
    with closing(Draughtsman()) as pen:
        pen.start()
        assert pen._other is None


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="processes cannot be bound")
def test_a_job_on_one_processor_starts_none() -> None:
    text = (
        "import os, sys; from contextlib import closing\n"
        "from iscat_analysis.draughtsman import Draughtsman\n"
        "every = os.sched_getaffinity(0)\n"
        "for allowed in ({min(every)}, every):\n"
        "    os.sched_setaffinity(0, allowed)\n"
        "    with closing(Draughtsman()) as pen: pen.start(); print(pen._other is None)"
    )
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "False"]


@pytest.mark.parametrize("platform", ["linux", "darwin"])
def test_one_that_cannot_be_started_is_done_without(
    platform: str, analysis: Analysis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.delitem(sys.modules, "matplotlib")
    monkeypatch.setattr(module.sys, "platform", platform)
    monkeypatch.setattr(module, "Copy", full)
    monkeypatch.setattr(module.sys, "executable", "/nowhere/python")
    with closing(Draughtsman()) as pen:
        pen.start()
        pen.begin(analysis, tmp_path, 12)
        pen.end(analysis.summary)
        assert pen.page() is None


@pytest.mark.parametrize("there", [True, False])
def test_where_there_are_no_copies_a_program_draws(
    there: bool,
    analysis: Analysis,
    expected: dict[str, bytes],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delitem(sys.modules, "matplotlib")
    monkeypatch.setattr(module.sys, "platform", "darwin")
    with closing(Draughtsman()) as pen:
        pen.start()
        monkeypatch.undo()
        pen.begin(analysis, tmp_path if there else tmp_path / "nowhere", 12)
        pen.end(analysis.summary)
        page = pen.page()
    assert (page or "").encode() == (expected["report.html"] if there else b"")


def test_it_is_started_at_the_latest_when_the_chunks_of_a_movie_are_done(tmp_path: Path) -> None:
    fewer = ["simulation.frames=200", "simulation.count=2", "simulation.leavings=0"]
    config = load_config(Path("sample_configs/landing.toml"), fewer)
    write_stack(config, tmp_path / "movie.tif")
    told: list[Any] = []

    class Pen(Draughtsman):
        def start(self) -> None:
            told.append("start")

    fit_stack(
        tmp_path / "movie.tif", config, draughtsman=Pen(),
        progress=lambda stage, done, total: told.append((stage, done >= total)),
    )  # fmt: skip
    assert told.index("start") + 1 == told.index(("landing", True))


def test_what_the_copy_cannot_draw_is_an_error(
    analysis: Analysis, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = os.getpid()

    def fail(*_: object, **__: object) -> dict[str, str]:
        if os.getpid() != here:
            raise OSError("no space left on device")
        return {}

    monkeypatch.setattr("iscat_analysis.report.drawing.publish", fail)
    with pytest.raises(OSError, match="no space left"):
        Drawing(analysis, tmp_path, 12, together=True).page(analysis)


def test_a_fit_loads_matplotlib_in_the_other_process_only() -> None:
    text = (
        "import sys, iscat_cli.app, iscat_analysis.pipeline, iscat_analysis.report.headline\n"
        "assert 'iscat_analysis.inference.fit' in sys.modules\n"
        "print(*({'matplotlib', 'jinja2', 'h5py', 'scipy.optimize'} & {*sys.modules}))"
    )
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    assert done.stdout == "\n"
