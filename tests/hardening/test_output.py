"""Whatever ends a run, the output folder is absent or whole, and the next run is undisturbed."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import Pipe
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet
import pytest
from forks import fork, send
from hardening.runner import hold, obey
from report_factory import make_analysis
from small_movies import LANDING

from iscat_analysis.config import load_config
from iscat_analysis.errors import DataError
from iscat_analysis.records import EVENT_COLUMNS, REPEAT_COLUMNS
from iscat_analysis.report import write_report
from iscat_analysis.report.output import OUTPUT_NAMES, atomic_folder, check_output
from iscat_analysis.search import chunks
from iscat_analysis.study import write_stack
from iscat_cli import main

KILLS = 50
"""Runs that are killed, where all of the large tests are run."""

SEED = 20_261_121
REQUIRED = OUTPUT_NAMES - {
    "figures", "posterior.nc", "response.csv", "tracks.csv", "tracks.parquet",
}  # fmt: skip
SETUP = """
[optics]
na = 1.3
attenuation = 0.1
calibrate = "never"
[camera]
pixel_size_nm = 84.4
frame_rate_hz = 200.0
exposure_ms = 5.0
[background]
frames = [0, 20]
[fit]
roi_nm = 1300.0
spheres = []
[posterior]
enabled = false
[compute]
workers = 1
[simulation]
shape = [48, 48]
frames = 40
events = [{frame = 20, x_px = 23.2, y_px = 24.4, mass_kda = 3000.0}]
"""
FIT = ["fit", "movie.tif", "--config", "setup.toml", "--out", "result", "--overwrite"]


@contextlib.contextmanager
def files_limited(size: int | None) -> Iterator[None]:
    """Let no file of this process grow beyond a size."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft if size is None else size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


class Runner:
    """Runs orders: in processes of their own, or here where none of them is ended.

    An order is one of `runner.py` with ``"cwd": folder``, and ``"kill": [signal, share]`` to be
    ended after that share of an undisturbed run's duration, or of ``"duration": seconds``; here,
    ``"limit": bytes`` is for the largest file it may write.  An answer is
    ``{"status": …, "err": …, "seconds": …}``; a signal's status is negative.
    """

    def __init__(self, folder: Path) -> None:
        self.bench = folder
        self.seconds: list[float] = []  # of undisturbed runs; the first one compiles

    def here(self, order: dict[str, Any]) -> dict[str, Any]:
        """Do in this process what `runner.py` does, which spares the imports of another one."""
        said, begin = io.StringIO(), time.monotonic()
        with (
            pytest.MonkeyPatch.context() as patch,
            files_limited(order.get("limit")),
            contextlib.chdir(order["cwd"]),
            contextlib.redirect_stdout(io.StringIO()),
            contextlib.redirect_stderr(said),
        ):
            if "memory_share" in order:
                patch.setattr(chunks, "MEMORY_SHARE", order["memory_share"])
            status = main(order["run"])
        seconds = time.monotonic() - begin
        if status == 0 and order == {"run": FIT, "cwd": order["cwd"]}:
            self.seconds.append(seconds)
        return {"status": status, "err": said.getvalue(), "seconds": seconds}

    def run(self, *orders: dict[str, Any]) -> list[dict[str, Any]]:
        with ThreadPoolExecutor(len(orders)) as pool:
            return list(pool.map(self._one, orders))

    def _one(self, order: dict[str, Any]) -> dict[str, Any]:
        begun, ready = Pipe(duplex=False)
        with tempfile.NamedTemporaryFile() as err:
            log = Path(err.name)
            process = fork(obey, order, ready, folder=order["cwd"], err=log)
            ready.close()
            begun.recv()
            begin = time.monotonic()
            if "kill" in order:
                number, share = order["kill"]
                process.join(share * order.get("duration", min(self.seconds)))
                send(process, number)
            process.join()
            seconds = time.monotonic() - begin
            said = log.read_text(encoding="utf-8", errors="backslashreplace")
        return {"status": process.exitcode, "err": said, "seconds": seconds}


@pytest.fixture(scope="module")
def runner(tmp_path_factory: pytest.TempPathFactory) -> Runner:
    """Return what runs programs, with a movie and its result."""
    bench = tmp_path_factory.mktemp("bench")
    (bench / "setup.toml").write_text(SETUP)
    write_stack(load_config(bench / "setup.toml"), bench / "movie.tif")
    runner = Runner(bench)
    first = runner.here({"run": FIT, "cwd": str(bench)})
    assert first["status"] == 0, first["err"]
    return runner


@pytest.fixture
def place(runner: Runner, tmp_path: Path) -> Path:
    """Return a folder with the movie and its configuration."""
    for name in ("movie.tif", "setup.toml"):
        shutil.copy(runner.bench / name, tmp_path)
    return tmp_path


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def assert_whole(result: Path, extra: tuple[str, ...] = ()) -> None:
    """Every file is there and complete; `extra` are the table's further columns.

    No spheres are tried, so that no column says what describes an image.
    """
    assert REQUIRED <= set(names(result)) <= OUTPUT_NAMES
    table = pd.read_csv(result / "fits.csv")
    columns = tuple(c for c in table.columns if not c.startswith("systematic_"))
    assert columns == (*EVENT_COLUMNS, *extra, *REPEAT_COLUMNS)
    with (result / "fits.parquet").open("rb") as file:
        assert len(pd.read_parquet(file)) == len(table)
    summary = json.loads((result / "summary.json").read_text(encoding="utf-8"))
    assert summary["events"] == (table["status"] != "sidelobe").sum()
    load_config(result / "config.toml")
    assert (result / "report.html").read_text(encoding="utf-8").rstrip().endswith("</html>")
    assert all(path.stat().st_size for path in result.glob("figures/*"))


def one_line(answer: dict[str, Any]) -> str:
    lines = answer["err"].splitlines()
    assert "Traceback" not in answer["err"]
    errors = [line for line in lines if ": error: " in line]
    assert len(errors) == 1, answer["err"]
    return errors[0]


def contents(result: Path) -> dict[str, bytes]:
    """All files, without the fields that say when and how fast.

    These are, and nothing else is, allowed to differ between two runs: ``seconds`` in
    ``summary.json``; in ``report.html`` the minute in its heading, and the rows *Started* and
    *seconds…* of its tables.
    """
    files = {}
    for path in sorted(result.rglob("*")):
        if path.is_dir():
            continue
        data = path.read_bytes()
        if path.name == "summary.json":
            summary = json.loads(data)
            assert summary.pop("seconds")
            data = json.dumps(summary).encode()
        if path.name == "report.html":
            row = rb"<div><dt>(?:[Ss]tarted|seconds\.\w+)</dt><dd>[^<]*</dd></div>"
            data, count = re.subn(row, b"", data)
            assert count
            data, count = re.subn(rb"\d+ \w+ \d{4}, \d\d:\d\d UTC", b"", data)
            assert count
        files[str(path.relative_to(result))] = data
    return files


def test_repeats_are_identical(runner: Runner, place: Path) -> None:
    """In a process that has done other things before, and in one of its own."""
    order = {"run": [*FIT, "--figures"], "cwd": str(place)}
    found = []
    for run in (runner.here, lambda order: runner.run(order)[0]):
        assert run(order)["status"] == 0
        assert_whole(place / "result")
        found.append(contents(place / "result"))
    assert len(found[0]) > 10
    assert differing(*found) == []


def differing(one: dict[str, bytes], two: dict[str, bytes]) -> list[str]:
    """Name the files that differ, each with the place where it begins to."""
    found = []
    for name in sorted(one.keys() | two.keys()):
        first, second = one.get(name, b""), two.get(name, b"")
        if first != second:
            pairs = enumerate(zip(first, second, strict=False))
            at = next((n for n, (a, b) in pairs if a != b), min(len(first), len(second)))
            found.append(f"{name}: {first[at - 60 : at + 60]!r} or {second[at - 60 : at + 60]!r}")
    return found


@pytest.mark.large
def test_killed_at_random_moments(runner: Runner, place: Path, share: float) -> None:
    rng = np.random.default_rng(SEED)
    expected = contents(runner.bench / "result")
    result = place / "result"
    for number in range(max(10, round(share * KILLS))):
        if rng.random() < 0.5:
            shutil.rmtree(result, ignore_errors=True)
        kill = [signal.SIGKILL, float(rng.uniform(0, 1.1))]
        order = {"run": FIT, "cwd": str(place), "kill": kill}
        (answer,) = runner.run(order)
        assert answer["status"] in (0, -signal.SIGKILL)
        hidden = [name for name in names(place) if name.startswith(".iscat-")]
        assert len(hidden) <= 3  # what the last run left; what earlier ones left is gone
        if result.exists():
            assert_whole(result)
        if number % 10 == 9:
            (again,) = runner.run({"run": FIT, "cwd": str(place)})
            assert again["status"] == 0, again["err"]
            assert differing(contents(result), expected) == []
            assert names(place) == ["movie.tif", "result", "setup.toml"]


@pytest.fixture(scope="module")
def landing(
    runner: Runner, tmp_path_factory: pytest.TempPathFactory
) -> tuple[dict[str, Any], float, dict[str, bytes]]:
    """Return the order for a landing movie of several chunks, its duration and its result."""
    place = tmp_path_factory.mktemp("landing")
    learns_nothing = LANDING.replace("[optics]", '[optics]\ncalibrate = "never"')
    (place / "setup.toml").write_text(learns_nothing.replace("[fit]", "[fit]\nspheres = []"))
    write_stack(load_config(place / "setup.toml"), place / "movie.tif")
    order = {"run": FIT, "cwd": str(place), "memory_share": 0.0031}
    whole = runner.here(order)
    assert whole["status"] == 0, whole["err"]
    assert not (place / ".result.partial").exists()
    summary = json.loads((place / "result" / "summary.json").read_text(encoding="utf-8"))
    assert summary["landing"]["chunks"] >= 4
    assert summary["events"] >= 3
    return order, whole["seconds"], contents(place / "result")


@pytest.mark.parametrize("chunks", [pytest.param(1, marks=pytest.mark.large), 3])
def test_a_landing_movie_killed_between_chunks_resumes(
    runner: Runner, landing: tuple[dict[str, Any], float, dict[str, bytes]], chunks: int
) -> None:
    order, _, expected = landing
    place = Path(order["cwd"])
    shutil.rmtree(place / "result", ignore_errors=True)
    (answer,) = runner.run({**order, "die": ["after", chunks]})
    assert answer["status"] == -signal.SIGKILL
    assert len(list((place / ".result.partial").glob("*.npz"))) == chunks
    again = runner.here(order)
    assert again["status"] == 0, again["err"]
    assert differing(contents(place / "result"), expected) == []
    assert names(place) == ["movie.tif", "movie.truth.csv", "result", "setup.toml"]


@pytest.mark.large
def test_a_landing_movie_killed_at_random_moments_resumes(
    runner: Runner, landing: tuple[dict[str, Any], float, dict[str, bytes]], share: float
) -> None:
    order, seconds, expected = landing
    place = Path(order["cwd"])
    result = place / "result"
    rng = np.random.default_rng(SEED)
    for number in range(max(10, round(share * KILLS / 2))):
        shutil.rmtree(result, ignore_errors=True)
        kill = [signal.SIGKILL, float(rng.uniform(0, 1))]
        (answer,) = runner.run({**order, "kill": kill, "duration": seconds})
        assert answer["status"] in (0, -signal.SIGKILL)
        if result.exists():
            assert_whole(result, extra=("frame_ci95",))
        if number % 5 == 4:
            shutil.rmtree(result, ignore_errors=True)
            (again,) = runner.run(order)
            assert again["status"] == 0, again["err"]
            assert differing(contents(result), expected) == []
            assert names(place) == ["movie.tif", "movie.truth.csv", "result", "setup.toml"]


@pytest.mark.parametrize(
    ("number", "word"),
    [
        (1, "after"),
        *(
            pytest.param(*case, marks=pytest.mark.large)
            for case in ((1, "before"), (2, "before"), (2, "after"))
        ),
    ],
)
def test_killed_between_two_renamings(runner: Runner, place: Path, word: str, number: int) -> None:
    """The one moment at which neither result has the final name: the next run puts one back."""
    shutil.copytree(runner.bench / "result", place / "result")
    (place / "result" / "summary.json").write_text('{"earlier": true}')
    (answer,) = runner.run({"run": FIT, "cwd": str(place), "die": [word, number]})
    assert answer["status"] == -signal.SIGKILL
    again = runner.here({"run": FIT[:-1], "cwd": str(place)})  # without --overwrite
    assert again["status"] == 1
    assert "holds an earlier result" in one_line(again)
    summary = json.loads((place / "result" / "summary.json").read_text())
    assert ("earlier" in summary) == ((word, number) != ("after", 2))
    again = runner.here({"run": FIT, "cwd": str(place)})
    assert again["status"] == 0
    assert_whole(place / "result")
    assert names(place) == ["movie.tif", "result", "setup.toml"]


@pytest.mark.parametrize(
    "number",
    [
        signal.SIGINT,
        *(pytest.param(n, marks=pytest.mark.large) for n in (signal.SIGTERM, signal.SIGHUP)),
    ],
)
def test_asked_to_end(
    runner: Runner, place: Path, number: int, repetitions: Callable[[int, int], int]
) -> None:
    rng = np.random.default_rng(SEED)
    for _ in range(repetitions(1, 3)):
        order = {"run": FIT, "cwd": str(place), "kill": [number, float(rng.uniform(0, 1))]}
        (answer,) = runner.run(order)
        assert answer["status"] in (0, 130, -number, -signal.SIGINT)  # before it began; too slow
        assert set(names(place)) - {"result"} == {"movie.tif", "setup.toml"}, answer
        if answer["status"] == 130 and answer["err"]:  # quiet before the command has begun
            assert "interrupted" in one_line(answer)
        if (place / "result").exists():
            assert_whole(place / "result")


@pytest.mark.parametrize("options", [pytest.param(FIT, marks=pytest.mark.large), FIT[:-1]])
def test_two_runs_into_one_folder(runner: Runner, place: Path, options: list[str]) -> None:
    answers = runner.run(*[{"run": options, "cwd": str(place)}] * 2)
    statuses = sorted(answer["status"] for answer in answers)
    assert statuses[0] == 0
    assert set(statuses) <= {0, 1}
    for answer in answers:
        if answer["status"]:
            assert re.search("another run|earlier result", one_line(answer))
    assert_whole(place / "result")
    assert names(place) == ["movie.tif", "result", "setup.toml"]


def test_a_run_that_is_under_way_is_respected(runner: Runner, place: Path) -> None:
    told, held = Pipe()
    holder = fork(hold, held, folder=place, err=Path(os.devnull))
    told.recv()
    answer = runner.here({"run": FIT, "cwd": str(place)})
    told.send(None)
    holder.join()
    assert holder.exitcode == 0
    assert answer["status"] == 1
    expected = f"result: another run (process {holder.pid}) is about to write there"
    assert expected in one_line(answer)
    assert not (place / "result").exists()


# ---- disks ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "limit", [8_000, *(pytest.param(n, marks=pytest.mark.large) for n in (600, 30_000))]
)
def test_a_file_that_cannot_grow(runner: Runner, place: Path, limit: int) -> None:
    answer = runner.here({"run": FIT, "cwd": str(place), "limit": limit})
    assert answer["status"] == 1
    assert re.search(r"result: cannot be written \(.*File too large\)", one_line(answer))
    assert names(place) == ["movie.tif", "setup.toml"]


def test_a_simulated_movie_that_cannot_grow(runner: Runner, place: Path) -> None:
    run = ["simulate", "--config", "setup.toml", "--out", "new.tif"]
    answer = runner.here({"run": run, "cwd": str(place), "limit": 50_000})
    assert answer["status"] == 1
    assert "new.tif: cannot be written" in one_line(answer)
    assert names(place) == ["movie.tif", "setup.toml"]


@pytest.fixture
def mount(tmp_path: Path) -> Iterator[Path]:
    """Return a small disk of its own, where this user may mount one."""
    disk = tmp_path / "disk"
    disk.mkdir()
    program = shutil.which("mount")
    if os.geteuid() != 0 or program is None:
        pytest.skip("only root can mount a small disk")
    made = subprocess.run(
        [program, "-t", "tmpfs", "-o", "size=400k", "tmpfs", str(disk)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if made.returncode:
        pytest.skip(f"no disk can be mounted here: {made.stderr.strip()}")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


def test_a_full_disk(mount: Path) -> None:
    analysis = make_analysis(3, "joint", posteriors=2)
    earlier = mount / "result"
    with atomic_folder(earlier) as building:
        (building / "fits.csv").write_text("event\n")
    ballast = mount / "ballast"
    for kilobytes in (390, 350, 290, 200):
        ballast.write_bytes(bytes(kilobytes * 1000))
        with pytest.raises(DataError, match=r"cannot be (written|made) \(.*\S"):
            write_report(analysis, earlier, overwrite=True)
        assert names(mount) == ["ballast", "result"]
        assert names(earlier) == [".iscat-files", "fits.csv"]


def test_a_read_only_disk(mount: Path, runner: Runner) -> None:
    shutil.copy(runner.bench / "movie.tif", mount)
    shutil.copy(runner.bench / "setup.toml", mount)
    subprocess.run(["mount", "-o", "remount,ro", str(mount)], check=True)
    run = ["fit", "movie.tif", "--config", "setup.toml"]
    answer = runner.here({"run": run, "cwd": str(mount)})
    assert answer["status"] == 1
    assert "movie.iscat: cannot be made (Read-only file system); choose another --out" in one_line(
        answer
    )
    assert "background" not in answer["err"]  # found out before the work, not after


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write into any folder")
def test_a_read_only_folder(tmp_path: Path) -> None:
    folder = tmp_path / "locked"
    folder.mkdir()
    folder.chmod(0o555)
    with pytest.raises(DataError, match="cannot be made"), atomic_folder(folder / "result"):
        pass
    folder.chmod(0o755)


# ---- names ---------------------------------------------------------------------------------------

NAMES = [
    "with several  spaces",
    "Ünïcödé – 粒子 🔬 \u202eabc",
    "-n",
    "a\nb\tc",
    "'quotes\" and $HOME `id` {x} %s <b>",
    "x" * 240,
    os.fsdecode(b"not \xff\xfe text"),
]


@pytest.mark.parametrize(
    "name",
    [NAMES[0], *(pytest.param(name, marks=pytest.mark.large) for name in NAMES[1:])],
    ids=range(len(NAMES)),
)
def test_names(runner: Runner, tmp_path: Path, name: str) -> None:
    folder = tmp_path / (name if len(name) < 200 else "y" * 200)
    folder.mkdir()
    shutil.copy(runner.bench / "movie.tif", folder / f"{name}.tif")
    shutil.copy(runner.bench / "setup.toml", folder / f"{name}.toml")
    config = f"--config={name}.toml"
    order = {"run": ["fit", config, "--", f"{name}.tif"], "cwd": str(folder)}
    answer = runner.here(order)
    assert answer["status"] == 0, answer["err"]
    assert_whole(folder / f"{name}.iscat")
    assert names(folder) == sorted(f"{name}.{end}" for end in ("tif", "toml", "iscat"))
    answer = runner.here(order)
    assert answer["status"] == 1
    assert "holds an earlier result" in one_line(answer)


@pytest.mark.parametrize("detour", ["new/..", "new/../../{}", "."])
def test_a_detour_never_replaces_a_folder_of_other_things(tmp_path: Path, detour: str) -> None:
    """`new` does not exist, so that only the resolved path says which folder is meant."""
    home = tmp_path / "home"
    home.mkdir()
    (home / "thesis.tex").write_text("years of work")
    with pytest.raises(DataError, match=r"thesis\.tex"):
        check_output(home / detour.format("home"), overwrite=True)
    with (
        pytest.raises(DataError, match=r"thesis\.tex"),
        atomic_folder(home / detour.format("home"), overwrite=True) as building,
    ):
        (building / "fits.csv").write_text("")
    assert names(tmp_path) == ["home"]
    assert names(home) == ["thesis.tex"]


def test_neighbours_with_similar_names_are_left_alone(tmp_path: Path) -> None:
    for name in (".iscat-building.abc.out.other", ".iscat-building.a.b.out", ".out", "out.old"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "file").write_text("")
    before = names(tmp_path)
    stale = tmp_path / ".iscat-building.abcdefgh.out"
    with atomic_folder(tmp_path / "out") as building:
        shutil.copytree(building, stale)  # as a run that is killed leaves it
    (stale / "fits.csv").write_text("half")
    shutil.rmtree(tmp_path / "out")
    with atomic_folder(tmp_path / "out") as building:
        (building / "fits.csv").write_text("event\n")
    assert names(tmp_path) == sorted([*before, "out"])
    assert all((tmp_path / name / "file").exists() for name in before)


# ---- read back -----------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["localize", "track"])
def test_tables_read_back_by_their_own_libraries(tmp_path: Path, mode: str) -> None:
    out = write_report(make_analysis(7, mode), tmp_path / "out")
    text = pd.read_csv(out / "fits.csv", keep_default_na=True)
    frame = pd.read_parquet(out / "fits.parquet")
    table = pyarrow.parquet.read_table(out / "fits.parquet")
    assert tuple(text.columns) == tuple(frame.columns) == EVENT_COLUMNS
    assert tuple(table.column_names) == EVENT_COLUMNS
    assert table.num_rows == len(text) == len(frame) == 7
    for name in EVENT_COLUMNS[:-2]:
        np.testing.assert_allclose(text[name], frame[name], rtol=1e-8, atol=0)
    assert text["status"].tolist() == frame["status"].tolist()
    assert text["flags"].fillna("").tolist() == frame["flags"].tolist()
