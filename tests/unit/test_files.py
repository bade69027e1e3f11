"""Files that are there whole or not at all."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from iscat_analysis.files import discard_unfinished, whole_file


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
    done, path = tmp_path / "done.csv", tmp_path / "table.csv"
    with whole_file(done) as partial:
        partial.write_text("whole")
    with suppress(FileNotFoundError), whole_file(path) as partial:
        partial.write_text("half")
        discard_unfinished()
        assert list(tmp_path.iterdir()) == [done]
