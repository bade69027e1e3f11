"""`iscat view`: which page is opened, and what is said where there is none."""

from __future__ import annotations

from pathlib import Path

import pytest

from iscat_cli import main


@pytest.fixture
def opened(monkeypatch) -> list[str]:
    """Put a browser in place that notes what it is told to open."""
    addresses: list[str] = []

    def open_page(address: str) -> bool:
        addresses.append(address)
        return "nowhere" not in address

    monkeypatch.setattr("webbrowser.open", open_page)
    return addresses


@pytest.mark.parametrize("name", ["report.html", "batch.html", "optics.html"])
def test_the_page_of_a_folder_is_opened(name: str, tmp_path: Path, opened, capsys) -> None:
    page = tmp_path / "a result" / name
    page.parent.mkdir()
    page.write_text("x")
    assert main(["view", str(page.parent)]) == 0
    assert opened == [page.as_uri()]
    assert capsys.readouterr().out == f"{page}\n"
    assert main(["view", str(page)]) == 0
    assert opened == 2 * [page.as_uri()]


def test_a_movie_has_its_result_beside_it(tmp_path: Path, opened, capsys) -> None:
    movie = tmp_path / "movie.tif"
    movie.write_bytes(b"II*\0")
    assert main(["view", str(movie)]) == 1
    assert "has no result beside it (movie.iscat)" in capsys.readouterr().err
    (tmp_path / "movie.iscat").mkdir()
    assert main(["view", str(movie)]) == 1
    assert "holds no page" in capsys.readouterr().err
    (tmp_path / "movie.iscat" / "report.html").write_text("x")
    assert main(["view", str(movie)]) == 0
    assert opened == [(tmp_path / "movie.iscat" / "report.html").as_uri()]


def test_what_cannot_be_opened_is_said_with_its_place(tmp_path: Path, opened, capsys) -> None:
    folder = tmp_path / "nowhere"
    assert main(["view", str(folder)]) == 1
    assert "there is no such folder" in capsys.readouterr().err
    folder.mkdir()
    (folder / "report.html").write_text("x")
    assert main(["view", str(folder)]) == 1
    said = capsys.readouterr()
    assert said.out == f"{folder / 'report.html'}\n"
    assert "no browser could be opened here" in said.err
    assert len(opened) == 1
