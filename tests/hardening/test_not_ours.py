"""Files and folders that this program did not write are neither followed, nor emptied, nor removed.

Each of them lies where the program would put something of its own.
"""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from small_movies import SETUP, simulate

import iscat_analysis as ia
from iscat_analysis.day.jobs import STATE, Records
from iscat_analysis.errors import DataError
from iscat_analysis.report.output import FILE_LIST, atomic_folder, check_output, claim_output

MINE = "years of work"


def _write(folder: Path, *, overwrite: bool = False, figure: str = "mass.png") -> None:
    """Write a result of three files."""
    with atomic_folder(folder, overwrite) as building:
        (building / "config.toml").write_text("ours")
        (building / "figures").mkdir()
        (building / "figures" / figure).write_text("ours")


def _names(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


WRITTEN = [FILE_LIST, "config.toml", "figures", "figures/mass.png"]


# ---- at the place of a lock ----------------------------------------------------------------------


@pytest.mark.parametrize("target", ["thesis.tex", "new"])
def test_a_link_in_the_place_of_a_lock_is_not_followed(tmp_path: Path, target: str) -> None:
    """Neither to a file of the user's nor to nothing, which it would make."""
    (tmp_path / "thesis.tex").write_text(MINE)
    link = tmp_path / ".iscat-lock.out"
    link.symlink_to(tmp_path / target)
    with pytest.raises(DataError, match=r"\.iscat-lock\.out: is in the place of a lock"):
        _write(tmp_path / "out")
    assert (tmp_path / "thesis.tex").read_text() == MINE
    assert {path.name for path in tmp_path.iterdir()} == {".iscat-lock.out", "thesis.tex"}
    assert link.is_symlink()


@pytest.mark.parametrize("content", [MINE, "1234"])
def test_a_file_in_the_place_of_a_lock_is_kept(tmp_path: Path, content: str) -> None:
    (tmp_path / ".iscat-lock.out").write_text(content)
    with pytest.raises(DataError, match="move it, or choose another `out`"):
        _write(tmp_path / "out")
    assert (tmp_path / ".iscat-lock.out").read_text() == content
    (tmp_path / ".iscat-lock.out").unlink()
    _write(tmp_path / "out")
    assert _names(tmp_path / "out") == WRITTEN


def test_an_empty_file_in_the_place_of_a_lock_is_kept(tmp_path: Path) -> None:
    (tmp_path / ".iscat-lock.out").touch()
    _write(tmp_path / "out")
    assert (tmp_path / ".iscat-lock.out").exists()
    assert _names(tmp_path / "out") == WRITTEN


def test_a_lock_that_a_killed_process_left_is_taken_over_and_removed(tmp_path: Path) -> None:
    program = (
        "import os, sys; from pathlib import Path\n"
        "from iscat_analysis.report.output import claim_output\n"
        "with claim_output(Path(sys.argv[1])): os._exit(0)"
    )
    subprocess.run([sys.executable, "-c", program, str(tmp_path / "out")], check=True)
    assert _names(tmp_path) == [".iscat-lock.out"]
    _write(tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]


def test_a_lock_does_not_stay_on_a_full_disk(tmp_path: Path) -> None:
    """No file can grow: not even the lock can say whose it is."""
    program = (
        "import os, resource, sys; from pathlib import Path\n"
        "from iscat_analysis.report.output import claim_output\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))\n"
        "before = os.listdir('/proc/self/fd')\n"
        "for _ in range(3):\n"
        "    with claim_output(Path(sys.argv[1])): pass\n"
        "assert os.listdir('/proc/self/fd') == before\n"
    )
    subprocess.run([sys.executable, "-c", program, str(tmp_path / "out")], check=True)
    assert _names(tmp_path) == []


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS])
def test_a_disk_without_locks_is_written(tmp_path: Path, monkeypatch, number: int) -> None:
    def flock(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", flock)
    with claim_output(tmp_path / "out"):
        _write(tmp_path / "out")
    with Records(tmp_path).held("job", lambda _: None):
        pass
    assert _names(tmp_path / "out") == WRITTEN
    assert sorted(path.name for path in tmp_path.iterdir()) == [STATE, "out"]


# ---- beside the folder ---------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["building", "earlier", "lock"])
def test_a_folder_of_the_users_with_such_a_name_is_kept(tmp_path: Path, kind: str) -> None:
    own = tmp_path / f".iscat-{kind}.mine.out"
    own.mkdir()
    (own / "thesis.tex").write_text(MINE)
    (own / "out").mkdir()
    (own / "out" / "thesis.tex").write_text(MINE)
    _write(tmp_path / "out")
    _write(tmp_path / "out", overwrite=True)
    assert _names(own) == ["out", "out/thesis.tex", "thesis.tex"]
    assert _names(tmp_path / "out") == WRITTEN


def test_a_link_with_such_a_name_is_not_followed(tmp_path: Path) -> None:
    _write(tmp_path / "elsewhere")
    (tmp_path / ".iscat-building.mine.out").symlink_to(tmp_path / "elsewhere")
    _write(tmp_path / "out")
    assert _names(tmp_path / "elsewhere") == WRITTEN


@pytest.mark.parametrize("kind", ["building", "earlier"])
def test_what_a_killed_run_left_is_removed(tmp_path: Path, kind: str) -> None:
    """The control: folders of the program's own, known by the list in them, do go."""
    with atomic_folder(tmp_path / "out") as building:
        left = tmp_path / f".iscat-{kind}.abcdefgh.out"
        shutil.copytree(building, left)
    if kind == "earlier":
        shutil.copytree(tmp_path / "out", left / "out")
    _write(tmp_path / "out", overwrite=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]


def test_finished_parts_are_removed_and_nothing_else(tmp_path: Path) -> None:
    simulate(tmp_path / "movie.tif", seed=1)
    parts = tmp_path / ".movie.iscat.partial"
    parts.mkdir()
    (parts / "thesis.tex").write_text(MINE)
    (parts / f"{'0' * 32}-00001.npz").write_text("of an earlier run")
    ia.fit_stack(tmp_path / "movie.tif", ia.configure(SETUP))
    assert _names(parts) == ["thesis.tex"]


# ---- in the folder -------------------------------------------------------------------------------


def test_a_folder_without_a_list_is_left_alone(tmp_path: Path) -> None:
    """Such as one of an earlier version, or one in which the user keeps a configuration."""
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "config.toml").write_text(MINE)
    for overwrite in (False, True):
        with pytest.raises(DataError, match=r"holds 'config\.toml' but not \.iscat-files"):
            _write(tmp_path / "out", overwrite=overwrite)
    assert (tmp_path / "out" / "config.toml").read_text() == MINE


@pytest.mark.parametrize("name", ["figures/mine.png", "figures/more/mine.png", "report.html"])
def test_what_the_list_does_not_name_stops_the_run(tmp_path: Path, name: str) -> None:
    _write(tmp_path / "out")
    (tmp_path / "out" / name).parent.mkdir(exist_ok=True)
    (tmp_path / "out" / name).write_text(MINE)
    with pytest.raises(DataError, match="which is not part of a result, and is left alone"):
        _write(tmp_path / "out", overwrite=True)
    assert (tmp_path / "out" / name).read_text() == MINE


def test_what_comes_while_a_result_is_replaced_stays(tmp_path: Path, monkeypatch) -> None:
    """Between the last look at the folder and its removal."""
    _write(tmp_path / "out")
    rename = Path.rename

    def late(self: Path, target: Path) -> Path:
        if self.name == "out":
            (self / "figures" / "mine.png").write_text(MINE)
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", late)
    _write(tmp_path / "out", overwrite=True)
    (kept,) = tmp_path.rglob("mine.png")
    assert kept.read_text() == MINE
    assert _names(tmp_path / "out") == WRITTEN


def test_a_list_removes_nothing_outside_its_folder(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text(MINE)
    _write(tmp_path / "out")
    with (tmp_path / "out" / FILE_LIST).open("a") as file:
        file.write('"../thesis.tex"\n"/thesis.tex"\n')
    _write(tmp_path / "out", overwrite=True)
    assert (tmp_path / "thesis.tex").read_text() == MINE


def test_a_link_in_a_result_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "mass.png").write_text(MINE)
    _write(tmp_path / "out")
    shutil.rmtree(tmp_path / "out" / "figures")
    (tmp_path / "out" / "figures").symlink_to(tmp_path / "mine")
    _write(tmp_path / "out", overwrite=True)
    assert (tmp_path / "mine" / "mass.png").read_text() == MINE
    assert _names(tmp_path / "out") == WRITTEN


@pytest.mark.parametrize("damage", [b"", b"my list\n", b"\xff\xfe", b"[" * 100_000])
def test_a_list_that_is_damaged_is_none(tmp_path: Path, damage: bytes) -> None:
    _write(tmp_path / "out")
    heading = (tmp_path / "out" / FILE_LIST).read_bytes().splitlines(keepends=True)[0]
    nested = heading if damage.startswith(b"[") else b""
    (tmp_path / "out" / FILE_LIST).write_bytes(nested + damage)
    with pytest.raises(DataError, match="left alone"):
        check_output(tmp_path / "out", overwrite=True)


def test_a_result_is_replaced_and_its_earlier_files_go(tmp_path: Path) -> None:
    """The control: what the list names does go."""
    _write(tmp_path / "out", figure="old.png")
    (tmp_path / "out" / "figures" / ".DS_Store").touch()
    _write(tmp_path / "out", overwrite=True)
    assert _names(tmp_path / "out") == WRITTEN
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]


# ---- in the folder of a day ----------------------------------------------------------------------


def test_a_link_in_the_place_of_a_days_records_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "mine" / "page").mkdir(parents=True)
    (tmp_path / "day").mkdir()
    simulate(tmp_path / "day" / "a.tif", seed=1)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / STATE).symlink_to(tmp_path / "mine")
    with pytest.raises(DataError, match=r"\.batch: is a link"):
        ia.batch(tmp_path / "day", out=tmp_path / "out", config=SETUP)
    assert _names(tmp_path / "mine") == ["page"]


def test_a_link_in_the_place_of_a_days_lock_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / STATE).mkdir()
    (tmp_path / STATE / "job.lock").symlink_to(tmp_path / "new")
    with (
        pytest.raises(DataError, match=r"job\.lock: is a link"),
        Records(tmp_path).held("job", lambda _: None),
    ):
        pass
    assert not (tmp_path / "new").exists()
