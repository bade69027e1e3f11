"""Files that are there whole or not at all."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import pytest

from iscat_analysis.files import discard_unfinished, unfinished, whole_file


def test_a_file_is_replaced_once_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("old")
    with whole_file(path) as partial:
        partial.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_failure_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("old")
    with suppress(KeyboardInterrupt), whole_file(path) as partial:
        partial.write_text("half")
        raise KeyboardInterrupt
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_process_that_ends_at_once_discards_what_is_unfinished(tmp_path: Path) -> None:
    done, path, folder = (tmp_path / name for name in ("done.csv", "table.csv", "folder"))
    with whole_file(done) as partial:
        partial.write_text("whole")
    with suppress(KeyboardInterrupt), unfinished(folder), whole_file(path) as partial:
        folder.mkdir()
        (folder / "table.csv").write_text("half")
        partial.write_text("half")
        discard_unfinished()
        assert list(tmp_path.iterdir()) == [done]


def test_what_is_being_discarded_is_not_put_in_place(tmp_path: Path) -> None:
    """Whoever removes it may be at the middle of a folder."""
    folder = tmp_path / "folder"
    folder.mkdir()
    with pytest.raises(KeyboardInterrupt), unfinished(folder):  # raised at its end
        discard_unfinished()


def test_what_ended_is_not_discarded(tmp_path: Path) -> None:
    kept, failed = tmp_path / "kept", tmp_path / "failed"
    with unfinished(kept):
        kept.mkdir()
    with suppress(ValueError), unfinished(failed):
        failed.mkdir()
        raise ValueError
    discard_unfinished()
    assert sorted(tmp_path.iterdir()) == [failed, kept]
