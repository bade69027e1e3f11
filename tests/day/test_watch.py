"""A folder that is being filled: what is taken, what is waited for, and what is told."""

from __future__ import annotations

import json
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from forks import fork, send
from small_movies import SETUP, analysed, put_in_place_of_fits
from tiff_files import write_ome_set

import iscat_analysis as ia
import iscat_analysis.day as day_module
from iscat_analysis.day import jobs
from iscat_analysis.day.watch import MOST_CHECKS, Ready, WatchedFolder
from iscat_analysis.errors import ConfigError, DataError, SchedulerError
from iscat_cli import main

COUNTS = np.arange(4 * 6 * 6, dtype="u2").reshape(4, 6, 6)
SET = np.arange(7 * 6 * 5, dtype="u2").reshape(7, 6, 5)
INTERVAL_S = 0.01


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return an empty folder."""
    place = tmp_path / "movies"
    place.mkdir()
    return place


def _names(look: Ready | None) -> list[str] | None:
    return None if look is None else [row.path.name for row in look[0].rows]


def _looks(folder: Path, told: list[str] | None = None) -> WatchedFolder:
    return WatchedFolder(folder, folder / "batch", (told if told is not None else []).append)


# ---- looks -----------------------------------------------------------------------------------


def test_a_movie_is_taken_once_it_rests(folder: Path) -> None:
    told: list[str] = []
    seen = _looks(folder, told)
    assert seen.check() is None
    np.save(folder / "a.npy", COUNTS)
    whole = (folder / "a.npy").read_bytes()
    for size in (200, 300):
        (folder / "a.npy").write_bytes(whole[:size])
        assert seen.check() is None
    (folder / "a.npy").write_bytes(whole)
    assert seen.check() is None
    assert _names(seen.check()) == ["a.npy"]
    assert seen.check() == seen.check()
    assert told == ["a.npy: is being written, and waited for"]


def test_a_movie_that_rests_but_cannot_be_read_is_waited_for_a_while(folder: Path) -> None:
    seen = _looks(folder)
    np.save(folder / "a.npy", COUNTS)
    (folder / "a.npy").write_bytes((folder / "a.npy").read_bytes()[:-10])
    assert [_names(seen.check()) for _ in range(MOST_CHECKS)] == [None] * MOST_CHECKS
    assert _names(seen.check()) == ["a.npy"]


def test_a_movie_that_a_program_has_open_is_waited_for_a_while(folder: Path) -> None:
    seen = _looks(folder)
    with h5py.File(folder / "a.h5", "w", libver="latest") as file:
        file["frames"] = COUNTS
        file.swmr_mode = True
        assert [_names(seen.check()) for _ in range(MOST_CHECKS)] == [None] * MOST_CHECKS
        assert _names(seen.check()) == ["a.h5"]
    os.utime(folder / "a.h5", (1, 1))
    assert seen.check() is None
    assert _names(seen.check()) == ["a.h5"]  # once it is closed


def test_nothing_is_done_while_a_movie_that_was_taken_changes_or_is_gone(folder: Path) -> None:
    seen = _looks(folder)
    for name in "ab":
        np.save(folder / f"{name}.npy", COUNTS)
    seen.check()
    first = seen.check()
    assert _names(first) == ["a.npy", "b.npy"]
    np.save(folder / "b.npy", COUNTS[:3])
    assert seen.check() is None
    again = seen.check()
    assert _names(again) == ["a.npy", "b.npy"]
    assert again != first
    (folder / "b.npy").unlink()
    assert [_names(seen.check()) for _ in range(MOST_CHECKS)] == [None] * MOST_CHECKS
    assert _names(seen.check()) == ["a.npy"]


def test_the_table_says_what_movies_are_and_may_grow(folder: Path) -> None:
    told: list[str] = []
    seen = _looks(folder, told)
    (folder / "samples.csv").write_text("path,sample,role\na.npy,buffer,blank\nz.npy,later,\n")
    for name in "ab":
        np.save(folder / f"{name}.npy", COUNTS)
    seen.check()
    look = seen.check()
    assert look is not None
    assert [(r.path.name, r.sample, r.role) for r in look[0].rows] == [
        ("a.npy", "buffer", "blank"), ("b.npy", "b", "sample"),
    ]  # fmt: skip
    assert told == ["z.npy: is in the table, and waited for"]
    (folder / "samples.csv").write_text("path,sample,role\na.npy,buffer,smaple\n")
    assert (seen.check(), seen.check(), seen.check()) == (None, None, None)
    (wrong,) = told[1:]
    assert "did you mean sample?" in wrong
    (folder / "samples.csv").write_text("path,sample\na.npy,BSA\n")
    assert seen.check() is None  # it may not be written to its end
    look = seen.check()
    assert look is not None
    assert [row.sample for row in look[0].rows] == ["BSA", "b"]


def test_a_set_is_waited_for_until_all_its_files_are_there(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "set").mkdir()
    first, *others = write_ome_set(tmp_path / "set", SET)
    seen = _looks(folder)
    shutil.copy(first, folder)
    assert (seen.check(), seen.check()) == (None, None)
    for path in others:
        shutil.copy(path, folder)
    assert seen.check() is None
    assert _names(seen.check()) == [first.name]


def test_results_in_the_folder_are_no_movies(folder: Path) -> None:
    out = folder / "day.zarr"
    (out / "movies").mkdir(parents=True)
    (folder / "a.iscat").mkdir()
    np.save(folder / "a.npy", COUNTS)
    seen = WatchedFolder(folder, out, [].append)
    seen.check()
    assert _names(seen.check()) == ["a.npy"]


def test_a_folder_that_cannot_be_read_is_waited_for(folder: Path) -> None:
    told: list[str] = []
    seen = _looks(folder, told)
    np.save(folder / "a.npy", COUNTS)
    seen.check()
    folder.rename(folder.with_name("away"))
    assert (seen.check(), seen.check()) == (None, None)
    assert len(told) == 1
    assert "cannot be read" in told[0]
    folder.with_name("away").rename(folder)
    seen.check()
    assert _names(seen.check()) == ["a.npy"]


# ---- analyses --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """Make a movie and its result."""
    return analysed(tmp_path_factory.mktemp("made"))


@pytest.fixture
def fits(made: Path, monkeypatch) -> list[str]:
    """Put the finished result in the place of every fit, and note the movies that it is of."""
    return put_in_place_of_fits(made, monkeypatch)


class Day:
    """What happens in a folder, each step once a line is told."""

    def __init__(self, *steps: tuple[str, Callable[[], object]]) -> None:
        self.steps, self.told = list(steps), []
        self.stop = threading.Event()

    def __call__(self, line: str) -> None:
        self.told.append(line)
        if self.steps and self.steps[0][0] in line:
            self.steps.pop(0)[1]()
        if not self.steps:
            self.stop.set()

    def watch(self, folder: Path, **options: object) -> ia.Batch | None:
        given: dict = {"config": SETUP, "interval_s": INTERVAL_S, **options}
        return ia.watch(folder, stop=self.stop, notify=self, **given)


def test_movies_are_analysed_as_they_come_and_failures_told_once(
    folder: Path, made: Path, fits: list[str]
) -> None:
    movie = made / "movie.tif"
    page = folder / "batch" / "batch.html"

    def damage() -> None:
        assert ">a<" in page.read_text()
        (folder / "cut.tif").write_bytes(movie.read_bytes()[:5000])

    def add() -> None:
        assert "not analysed" in page.read_text()
        shutil.copy(movie, folder / "b.tif")

    day = Day(
        ("looks at", lambda: shutil.copy(movie, folder / "a.tif")),
        ("1 done", damage),
        ("1 done, 1 failed", add),
        ("2 done, 1 failed", lambda: shutil.copy(movie, folder / "cut.tif")),
        ("3 done", lambda: None),
    )
    found = day.watch(folder)
    assert found is not None
    assert fits == ["a.tif", "b.tif", "cut.tif"]
    assert len([line for line in day.told if line.startswith("cut: failed")]) == 1
    assert found.movies["movie"].tolist() == ["a", "b", "cut"]
    assert set(found.analysed) == {"a", "b", "cut"}
    assert found.failed == ()
    assert "batch.html" in day.told[-1]

    again = Day(("looks at", lambda: None), ("never", lambda: None))
    threading.Timer(1.0, again.stop.set).start()
    kept = again.watch(folder)
    assert kept is None or kept.analysed == ()
    assert fits == ["a.tif", "b.tif", "cut.tif"]


def test_a_new_movie_makes_one_page(folder: Path, made: Path, fits: list[str], monkeypatch) -> None:
    pages: list[int] = []
    publish = day_module.publish_day
    monkeypatch.setattr(
        day_module, "publish_day", lambda *a, **k: (pages.append(len(fits)), publish(*a, **k))[1]
    )
    shutil.copy(made / "movie.tif", folder / "a.tif")
    day = Day(
        ("1 done", lambda: shutil.copy(made / "movie.tif", folder / "b.tif")),
        ("2 done", lambda: None),
    )
    day.watch(folder)
    assert pages[:2] == [1, 2]  # how many movies were finished when a page was made
    assert len(pages) <= 3  # and the last one, when the watching ended


def test_what_failed_is_tried_again_when_the_watching_begins(
    folder: Path, made: Path, fits: list[str], monkeypatch
) -> None:
    shutil.copy(made / "movie.tif", folder / "a.tif")
    with monkeypatch.context() as patch:
        patch.setattr(jobs, "fit_stack", lambda *_, **__: 1 / 0)
        day = Day(("a: failed", lambda: None), ("1 failed", lambda: None))
        first = day.watch(folder)
    assert first is not None
    assert first.failed == (("a", "unexpected ZeroDivisionError: division by zero"),)
    second = Day(("1 done", lambda: None)).watch(folder)
    assert second is not None
    assert (fits, second.failed) == (["a.tif"], ())


def test_an_interrupt_ends_with_a_page_of_what_is_finished(
    folder: Path, made: Path, fits: list[str], monkeypatch, capsys, tmp_path: Path
) -> None:
    finish = jobs.fit_stack

    def stopped(movie: Path, *arguments: object, **options: object) -> object:
        if movie.name == "b.tif":
            raise KeyboardInterrupt
        return finish(movie, *arguments, **options)  # type: ignore[arg-type]

    for name in "abc":
        shutil.copy(made / "movie.tif", folder / f"{name}.tif")
    setup = tmp_path / "setup.toml"
    setup.write_text(ia.config_to_toml(ia.configure(SETUP)), encoding="utf-8")
    command = ["watch", str(folder), "--config", str(setup), "--interval", str(INTERVAL_S)]
    with monkeypatch.context() as patch:
        patch.setattr(jobs, "fit_stack", stopped)
        assert main([*command, "--out", str(tmp_path / "day")]) == 130
    said = capsys.readouterr()
    assert "1 of 3 movies done, 1 of them now" in said.out
    assert "iscat watch: ending" in said.err
    assert "not analysed yet" in (tmp_path / "day" / "batch.html").read_text()
    assert fits == ["a.tif"]


def test_without_movies_too_one_object_is_printed(folder: Path, monkeypatch, capsys) -> None:
    def interrupt(_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(WatchedFolder, "check", interrupt)
    assert main(["watch", str(folder), "--json", "--quiet"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["out"] == str(folder / "batch")
    assert printed["movies"] == []


def test_ctrl_c_ends_the_waiting_without_an_error(folder: Path, tmp_path: Path) -> None:
    out, err = tmp_path / "out", tmp_path / "err"
    command = ["watch", str(folder), "--interval", "3600"]
    process = fork(main, command, folder=tmp_path, out=out, err=err)
    try:
        while process.is_alive() and not (err.exists() and "Ctrl-C ends it" in err.read_text()):
            time.sleep(0.02)
        send(process, signal.SIGINT)
        process.join(60)
    finally:
        process.kill()
    assert process.exitcode == 0
    assert out.read_text() == f"no movie came into {folder}\n"
    assert "error" not in err.read_text()


# ---- what is wrong ---------------------------------------------------------------------------


def test_what_cannot_be_watched_is_refused_at_once(folder: Path, capsys) -> None:
    for options, said in (
        ([str(folder / "absent")], "there is no such folder"),
        ([str(folder), "--interval", "0"], "--interval 0: give one number above 0"),
        ([str(folder), "--interval", "nan"], "--interval nan: give one number above 0"),
        ([str(folder), "--out", str(folder)], "choose another --out"),
        ([str(folder), "--standards", "x"], "--standards: 'x' is not a mass"),
        ([str(folder), "--set", "optics.nna=1"], "did you mean"),
    ):
        assert main(["watch", *options]) == 2, said
        assert said in capsys.readouterr().err
    (folder / "one.npy").write_bytes(b"")
    for option, value in (("--standards", "66"), ("--kd-masses", "66,132"), ("--scheduler", "x:1")):
        assert main(["watch", str(folder / "one.npy"), option, value]) == 2
        assert f"{option} is for a folder of movies" in capsys.readouterr().err
    (folder / "one.npy").unlink()
    (folder / "samples.csv").write_text("path,role\n")
    (folder / "samples.toml").write_text("")
    with pytest.raises(ConfigError, match=r"samples.csv and samples.toml"):
        ia.watch(folder)
    (folder / "samples.toml").unlink()
    (folder / "samples.csv").write_text("sample\na\n")
    with pytest.raises(ConfigError, match="lacks the column path"):
        ia.watch(folder)
    (folder / "samples.csv").unlink()
    (folder / "batch").mkdir()
    (folder / "batch" / "mine").write_text("x")
    with pytest.raises(DataError, match="is no earlier batch"):
        ia.watch(folder)


def test_a_row_that_is_wrong_is_waited_for(folder: Path, made: Path, fits: list[str]) -> None:
    shutil.copy(made / "movie.tif", folder / "a.tif")
    table = folder / "samples.csv"
    table.write_text("path,optics.nna\na.tif,1.3\n")
    day = Day(
        ("did you mean", lambda: table.write_text("path,optics.na\na.tif,1.3\n")),
        ("1 done", lambda: None),
    )
    found = day.watch(folder)
    assert found is not None
    assert found.movies["state"].tolist() == ["done"]
    assert fits == ["a.tif"]


@pytest.mark.parametrize("error", [SchedulerError("it is gone"), OSError("no disk")])
def test_what_hinders_all_movies_is_told_once_and_waited_for(
    folder: Path, made: Path, fits: list[str], monkeypatch, error: Exception
) -> None:
    left = [error, error, error]

    def hindered(*arguments: Any, **options: Any) -> ia.Batch:
        if left:
            raise left.pop()
        return ia.batch(*arguments, **options)

    monkeypatch.setattr("iscat_analysis.day.watch.batch", hindered)
    shutil.copy(made / "movie.tif", folder / "a.tif")
    day = Day(("1 done", lambda: None))
    found = day.watch(folder)
    assert found is not None
    assert found.failed == ()
    assert fits == ["a.tif"]
    assert [line for line in day.told if str(error) in line] == [
        f"{error}; waiting until it is mended"
    ]
    assert f">{folder.name}<" in found.page.read_text(encoding="utf-8")


def test_a_folder_without_movies_ends_without_a_page(folder: Path, tmp_path: Path) -> None:
    assert Day(("looks at", lambda: None)).watch(folder, out=tmp_path / "day") is None
    assert not (tmp_path / "day" / "batch.html").exists()
