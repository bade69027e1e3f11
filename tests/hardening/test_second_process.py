"""A second process shares a large movie: same results, and it ends with the first."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from jobs import warn
from small_movies import LANDING

from iscat_analysis.config import load_config
from iscat_analysis.second_process import SecondProcess
from iscat_analysis.study import write_stack

pytestmark = pytest.mark.large

SETUP = LANDING.replace("workers = 1", "workers = 2")

# Jobs that are sent are named on stderr, with the process that does them; a small movie is cut into
# as many chunks as a large one, and shared where it has more bytes than the first argument.
PROGRAM = """
import os, signal, sys
from iscat_analysis import executors
from iscat_analysis.search.sliding import chunks
from iscat_cli import main

chunks.MEMORY_SHARE = 0.0031
executors.processors = lambda: 2
executors._LARGE_BYTES = float(sys.argv.pop(1))
lost = int(sys.argv.pop(1))
call = executors.SecondProcess.call

def named(self, job, *arguments):
    print("sent", job.__name__, self._pool.submit(os.getpid).result(), file=sys.stderr, flush=True)
    if lost:
        self._pool.submit(signal.raise_signal, signal.SIGKILL)
    return call(self, job, *arguments)

executors.SecondProcess.call = named
sys.exit(main())
"""
FIT = ["fit", "movie.tif", "--config", "setup.toml", "--overwrite", "--out"]
SHARED, ALONE = "0", "inf"


def command(large: str, out: str, *, lost: bool = False) -> list[str]:
    return [sys.executable, "-c", PROGRAM, large, str(int(lost)), *FIT, out]


def run(place: Path, large: str, out: str, *, lost: bool = False) -> str:
    done = subprocess.run(
        command(large, out, lost=lost), cwd=place, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stderr


def contents(result: Path) -> dict[str, Any]:
    """All files, without what says when, how fast and where to."""
    found: dict[str, Any] = {
        str(path.relative_to(result)): path.read_bytes()
        for path in result.rglob("*")
        if path.is_file() and path.name != "report.html"
    }
    summary = json.loads(found["summary.json"])
    for name in ("seconds", "command", "started"):
        summary.pop(name, None)
    summary.get("provenance", {}).pop("command", None)
    summary.get("provenance", {}).pop("started", None)
    return {**found, "summary.json": summary}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a movie, and what one process finds in it."""
    place = tmp_path_factory.mktemp("shared")
    (place / "setup.toml").write_text(SETUP)
    write_stack(load_config(place / "setup.toml"), place / "movie.tif", seed=5)
    assert "sent" not in run(place, ALONE, "alone")
    summary = json.loads((place / "alone" / "summary.json").read_text(encoding="utf-8"))
    assert summary["landing"]["chunks"] >= 4
    assert summary["events"] >= 3
    return place


def test_two_processes_find_what_one_finds_to_the_byte(place: Path) -> None:
    said = run(place, SHARED, "two")
    assert "sent chunk_job" in said
    assert "sent draw_part" in said
    expected = contents(place / "alone")
    found = contents(place / "two")
    assert found.keys() == expected.keys()
    assert [name for name in expected if found[name] != expected[name]] == []
    assert len(expected) > 10


def test_warnings_of_the_second_process_are_said_by_the_first() -> None:
    second = SecondProcess([])
    try:
        with pytest.warns(UserWarning, match="of the other"):
            second.call(warn, "of the other")
    finally:
        second.close()


def test_the_work_of_a_lost_process_is_done_again(place: Path) -> None:
    said = run(place, SHARED, "lost", lost=True)
    assert said.count("sent") == 1
    assert "the second process was ended from outside" in said
    assert "Traceback" not in said
    assert contents(place / "lost") == contents(place / "alone")


@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.large), signal.SIGKILL]
)
def test_the_second_process_ends_with_the_first(place: Path, number: signal.Signals) -> None:
    process = subprocess.Popen(
        command(SHARED, f"ended-{number}"), cwd=place, stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stderr is not None
        for line in process.stderr:
            if (found := re.match(r"sent chunk_job (\d+)", line)) is not None:
                break
        assert found is not None
        second = int(found[1])
        os.kill(second, 0)  # it is there
        process.send_signal(number)
        said = process.communicate(timeout=120)[1]
        assert "Traceback" not in said
        if number == signal.SIGKILL:
            assert process.returncode == -number
        else:
            assert process.returncode in (130, -signal.SIGINT)
            assert "interrupted" in said
        due = time.monotonic() + 60
        with suppress(ProcessLookupError):
            while time.monotonic() < due:
                os.kill(second, 0)
                time.sleep(0.1)
            pytest.fail(f"process {second} goes on without the first")
    finally:
        process.kill()
