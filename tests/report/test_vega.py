"""Figures as data: specifications, what fills them, and the scripts that draw them."""

from __future__ import annotations

import hashlib
import json
import re
from importlib.resources import files
from pathlib import Path

import pytest
from report_factory import make_analysis

from iscat_analysis.errors import DataError
from iscat_analysis.report import render_report
from iscat_analysis.report.movie_figures import movie_figures
from iscat_analysis.report.vega import MIME_TYPE, figure, figures_in, libraries

REPORT = Path(str(files("iscat_analysis.report")))
SPECIFICATIONS = sorted((REPORT / "specifications").glob("*.vl.json"))


def test_the_vendored_scripts_are_those_of_their_list() -> None:
    entries = json.loads((REPORT / "vendor" / "libraries.json").read_text(encoding="utf-8"))
    assert {entry["license"] for entry in entries} == {"BSD-3-Clause"}
    licence = (REPORT / "vendor" / "LICENSE").read_text(encoding="utf-8")
    for entry in entries:
        content = (REPORT / "vendor" / entry["file"]).read_bytes()
        assert hashlib.sha256(content).hexdigest() == entry["sha256"], entry["name"]
        assert f"{entry['name']} {entry['version']}" in licence
    assert len(libraries().encode()) < 850_000


@pytest.mark.parametrize("path", SPECIFICATIONS, ids=lambda path: path.name)
def test_every_specification_is_named_described_and_made_in_one_place(path: Path) -> None:
    """A figure that were described twice would have two makers, or none in the library."""
    name = path.name.removesuffix(".vl.json")
    specification = json.loads(path.read_text(encoding="utf-8"))
    assert specification["usermeta"]["name"] == name
    assert specification["usermeta"]["title"]
    assert specification["description"].endswith(".")
    makers = [
        module.name
        for module in REPORT.rglob("*.py")
        for _ in re.finditer(rf'figure\(\s*"{name}"', module.read_text(encoding="utf-8"))
    ]
    assert len(makers) == 1, (name, makers)


def test_words_are_filled_in_and_none_may_be_missing() -> None:
    words = {"title": "Misfit", "quantity": "χ²", "counted": "fits", "caption": ""}
    bars = {"bars": {"low": [0], "high": [1], "count": [2]}, "expected": {"x": [1], "y": [0]}}
    drawn = figure("histogram", bars, words)
    assert drawn.description == "Histogram of χ²."
    assert drawn.to_dict()["datasets"]["bars"] == [{"low": 0, "high": 1, "count": 2}]
    with pytest.raises(KeyError, match="caption"):
        figure("histogram", bars, {key: words[key] for key in ("title", "quantity", "counted")})


def test_a_layer_without_rows_is_left_out() -> None:
    words = {"title": "Misfit", "quantity": "χ²", "counted": "fits", "caption": ""}
    bars = {"low": [0], "high": [1], "count": [2]}
    drawn = figure("histogram", {"bars": bars, "expected": {}}, words)
    assert [layer["data"]["name"] for layer in drawn.specification["layer"]] == ["bars"]
    assert set(drawn.data) == {"bars"}


def test_a_notebook_shows_a_figure_and_a_file_holds_it(tmp_path: Path) -> None:
    drawn = movie_figures(make_analysis(12))["masses"]
    shown = drawn._repr_mimebundle_()
    assert shown[MIME_TYPE]["$schema"].endswith("v6.json")
    assert shown[MIME_TYPE]["datasets"]["bars"]
    assert set(drawn._repr_mimebundle_(include=["text/plain"])) == {"text/plain"}
    assert set(drawn._repr_mimebundle_(exclude=["text/plain"])) == {MIME_TYPE}
    saved = json.loads(drawn.save(tmp_path / "masses.vl.json").read_text(encoding="utf-8"))
    assert saved == json.loads(json.dumps(drawn.to_dict()))


def test_a_page_gives_its_figures_back(tmp_path: Path) -> None:
    analysis = make_analysis(30, "track")
    page = tmp_path / "report.html"
    page.write_text(render_report(analysis), encoding="utf-8")
    made, read = movie_figures(analysis), figures_in(page)
    assert list(made) == list(read)
    for name, drawn in made.items():
        assert read[name].to_dict()["datasets"] == drawn.to_dict()["datasets"], name
    page.write_text("<html></html>", encoding="utf-8")
    with pytest.raises(DataError, match="holds no figures"):
        figures_in(page)
