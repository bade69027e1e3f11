"""What the window does without a browser: its form, its list of rejections, its queue."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

import iscat_analysis as ia

pytest.importorskip("panel", reason="needs the Python package panel")

from iscat_app.chosen import Chosen, table_of
from iscat_app.files import listed
from iscat_app.form import FIRST, Form, add_table, fields, read_texts, write_texts
from iscat_app.rejections import Rejections
from iscat_app.runs import Queue


def test_the_form_has_every_key_of_the_configuration_once() -> None:
    keys = [field.key for field in fields()]
    assert len(set(keys)) == len(keys)
    expected = {
        f"{section}.{name}"
        for section, model in ia.Config.model_fields.items()
        if section not in ("simulation", "bounds", "calibration")
        for name in model.annotation.model_fields
    }
    assert expected <= set(keys)
    assert set(FIRST) <= set(keys)
    choices = {field.key: field.choices for field in fields()}
    assert choices["fit.mode"] == ("mass", "localize", "joint", "size", "track")
    assert choices["background.power_normalization"] == (True, False)


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "iscat.toml"
    texts = {"camera.pixel_size_nm": "84", "particle.kind": "gold", "fit.frames": "[0, 40]"}
    config = write_texts(path, texts)
    assert ia.load_config(path) == config
    assert (config.camera.pixel_size_nm, config.particle.kind) == (84.0, "gold")
    assert write_texts(path, read_texts(path)) == config


def test_what_cannot_be_is_refused_and_leaves_the_file(tmp_path: Path) -> None:
    path = tmp_path / "iscat.toml"
    write_texts(path, {"optics.na": "1.3"})
    before = path.read_bytes()
    with pytest.raises(ia.ConfigError, match=r"optics\.na"):
        write_texts(path, {"optics.na": "-1"})
    with pytest.raises(ia.ConfigError, match=r"optics\.nna"):
        write_texts(path, {"optics.nna": "1.3"})
    assert path.read_bytes() == before


def test_saving_keeps_what_the_form_does_not_show(tmp_path: Path, sample_configs) -> None:
    path = tmp_path / "iscat.toml"
    path.write_bytes(sample_configs["landing"].read_bytes())
    before = ia.load_config(path)
    chosen = Chosen()
    chosen.choose(tmp_path / "movie.tif")
    form = Form(chosen)
    form.refresh()
    form._save(None)
    assert ia.load_config(path) == before


def test_a_calibration_replaces_only_its_section(tmp_path: Path) -> None:
    path = tmp_path / "iscat.toml"
    write_texts(path, {"optics.na": "1.3", "calibration.gradient_per_kda": "-1e-5"})
    add_table(path, "calibration", "[calibration]\ngradient_per_kda = -3e-5\noffset = 1e-4\n")
    config = ia.load_config(path)
    assert config.calibration is not None
    assert (config.optics.na, config.calibration.gradient_per_kda) == (1.3, -3e-5)


@pytest.fixture
def table() -> pd.DataFrame:
    return pd.DataFrame(
        {"event": [0, 1, 2], "frame": [10, 20, 30], "x_px": [5.0, 6.0, 7.0],
         "y_px": [1.0, 2.0, 3.0], "mass_kda": [66.0, 146.0, 480.0]}
    )  # fmt: skip


def test_rejections_are_a_list_that_can_be_taken_back(tmp_path: Path, table: pd.DataFrame) -> None:
    Rejections(tmp_path / "a.iscat").reject(table.iloc[[0, 2]])
    again = Rejections(tmp_path / "a.iscat")
    assert again.events(table) == {0, 2}
    again.reject(table.iloc[[2]])
    assert len(again.rows) == 2
    again.take_back({0})
    assert Rejections(tmp_path / "a.iscat").events(table) == {2}


def test_a_new_analysis_does_not_inherit_rejections_of_other_events(
    tmp_path: Path, table: pd.DataFrame
) -> None:
    kept = Rejections(tmp_path / "a.iscat")
    kept.reject(table.iloc[[0, 1]])
    anew = table.assign(x_px=[5.1, 40.0, 7.0])  # event 1 is another one now
    assert kept.events(anew) == {0}
    assert kept.lost(anew) == 1
    kept.path.write_text("no list", encoding="utf-8")
    with pytest.raises(ia.DataError, match="move it away"):
        Rejections(tmp_path / "a.iscat")


def test_a_run_that_cannot_be_fails_in_words_and_is_not_put_twice(tmp_path: Path) -> None:
    queue = Queue()
    queue.close()  # nothing begins
    run = queue.add(tmp_path / "a.tif", None, tmp_path / "a.iscat", settings=["optics.na=1.3"])
    assert queue.add(tmp_path / "a.tif", None, tmp_path / "a.iscat") is run
    assert run.command.startswith("iscat-fit ")
    assert "--set optics.na=1.3" in run.command
    queue.stop(run)
    assert run.state == "stopped"
    assert queue.again(run) is not run


def test_names_are_text_whatever_is_in_them(tmp_path: Path) -> None:
    (tmp_path / "<img src=x onerror=alert(1)>.tif").touch()
    (tmp_path / "b.iscat").mkdir()
    (tmp_path / "b.iscat" / "summary.json").write_text("{}", encoding="utf-8")
    assert [entry.kind for entry in listed(tmp_path)] == ["folder", "movie", "result"]
    assert "<img" not in table_of([("<img src=x>", "a")])
