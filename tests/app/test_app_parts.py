"""What the window does without a browser: its form, its list of rejections, its queue."""

from __future__ import annotations

import json
import multiprocessing
import shlex
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import tifffile
from app_results import standards_result, uncalibrated

import iscat_analysis as ia
from iscat_analysis.report.answer import answer_in

pytest.importorskip("panel", reason="needs the Python package panel")

from iscat_app.calibrate import Calibrate
from iscat_app.chosen import Chosen
from iscat_app.compare import Compare
from iscat_app.export import Export
from iscat_app.files import Files, listed, result_facts
from iscat_app.form import FIRST, Form, fields
from iscat_app.results import Rejections, Results
from iscat_app.runs import Job, Queue
from iscat_app.settings import add_table, beside, read_texts, take, write_texts
from iscat_app.widgets import table_of
from iscat_cli import main


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
    form._save()
    assert ia.load_config(path) == before


def test_a_calibration_replaces_only_its_section(tmp_path: Path) -> None:
    path = tmp_path / "iscat.toml"
    write_texts(path, {"optics.na": "1.3", "calibration.gradient_per_kda": "-1e-5"})
    add_table(path, "calibration", "[calibration]\ngradient_per_kda = -3e-5\noffset = 1e-4\n")
    config = ia.load_config(path)
    assert config.calibration is not None
    assert (config.optics.na, config.calibration.gradient_per_kda) == (1.3, -3e-5)


def test_calibrations_beside_a_movie_go_into_its_configuration(tmp_path: Path) -> None:
    for name, text in (
        ("a.camera/camera.toml", '[camera]\ngain_e_per_adu = 2.5  # 95 %\noffset_adu = "o.tif"\n'),
        ("b.optics/optics.toml", "[optics]\nna = 1.31\n"),
        ("c.calibration/calibration.toml", "[calibration]\ngradient_per_kda = -3e-5\n"),
        ("d.optics/optics.html", "refused: there is no optics.toml"),
    ):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text(text, encoding="utf-8")
    tifffile.imwrite(tmp_path / "a.camera" / "o.tif", np.full((4, 4), 100, np.float32))
    found = beside(tmp_path)
    assert [*found] == ["camera: a", "optics: b", "line of the masses: c"]
    setup = tmp_path / "iscat.toml"
    write_texts(setup, {"camera.pixel_size_nm": "84", "camera.gain_e_per_adu": "1.0"})
    for path in found.values():
        take(Path(path), setup)
    config = ia.load_config(setup)
    assert (config.camera.pixel_size_nm, config.camera.gain_e_per_adu) == (84.0, 2.5)
    assert config.camera.offset_adu == str(tmp_path / "a.camera" / "o.tif")
    assert config.optics.na == 1.31
    assert config.calibration is not None
    assert config.calibration.gradient_per_kda == -3e-5


def test_frames_that_are_left_out_add_up_in_the_form(tmp_path: Path) -> None:
    (tmp_path / "iscat.toml").write_text("[fit]\nexcluded_frames = [[5, 9]]\n", encoding="utf-8")
    chosen = Chosen()
    chosen.choose(tmp_path / "movie.tif")
    form = Form(chosen)
    form.refresh()
    chosen.excluded = (20, 40)
    form.refresh()
    form._save()
    assert ia.load_config(tmp_path / "iscat.toml").fit.excluded_frames == ((5, 9), (20, 40))


def test_what_is_wrong_stands_below_its_field(tmp_path: Path) -> None:
    chosen = Chosen()
    chosen.choose(tmp_path / "movie.tif")
    form = Form(chosen)
    form.refresh()
    form._widgets["optics.na"].value = "-1"
    shown = {key for key, wrong in form._warned.items() if wrong.visible}
    assert shown == {"optics.na"}
    assert "greater than 0" in form._warned["optics.na"].object
    form._widgets["optics.na"].value = "1.3"
    assert not any(wrong.visible for wrong in form._warned.values())


@pytest.fixture
def standards(tmp_path: Path) -> Path:
    """Make a result whose peaks lie at 66, 132 and 264 kDa."""
    return standards_result(tmp_path / "standards.iscat", np.random.default_rng(3))


def test_a_click_gives_a_peak_its_mass_and_takes_it_back(standards: Path) -> None:
    chosen = Chosen(result=standards)
    calibrate = Calibrate(chosen, Queue())
    calibrate.refresh()
    assert len(calibrate.peaks) == 3
    calibrate._standards.value = "264, 132"
    for percent in (0.42, 0.80, 0.20):  # near 3.1e-5 · 132; there is no third mass
        calibrate._clicked("pick", [{"x": percent}])
    assert calibrate.assigned == {1: 132.0, 2: 264.0}
    calibrate._clicked("pick", [{"x": 0.41}])
    assert calibrate.assigned == {2: 264.0}
    calibrate._standards.value = "66"
    assert calibrate.assigned == {}


def test_peaks_have_masses_by_the_keyboard_too(standards: Path) -> None:
    calibrate = Calibrate(Chosen(result=standards), Queue())
    calibrate.refresh()
    calibrate._standards.value = "66, 264"
    calibrate._peak.value = 0
    calibrate._give(calibrate._peak.value)
    calibrate._peak.value = 2
    calibrate._give(calibrate._peak.value)
    assert calibrate.assigned == {0: 66.0, 2: 264.0}
    assert next(iter(calibrate._peak.options)).endswith(", 66 kDa")


def test_a_result_says_its_answer(standards: Path) -> None:
    answer = answer_in(standards)
    assert answer
    assert dict(result_facts(standards))["answer"] == answer


@pytest.mark.parametrize("rejects", [False, True])
def test_the_command_that_is_exported_finds_the_species_of_the_window(
    standards: Path, tmp_path: Path, capsys: Any, rejects: bool
) -> None:
    """Its search would have seen 20 kDa, and not only what is as heavy as its lightest event."""
    summary = json.loads((standards / "summary.json").read_text())
    summary["detection_threshold_snr"] = 3.0
    (standards / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    chosen, queue = Chosen(result=standards), Queue()
    results = Results(chosen)
    export = Export(chosen, results, Compare(chosen, queue))
    results.refresh()
    if rejects:
        assert results.rejections is not None
        results.rejections.reject(results.table.iloc[[0, 1, 5]])
        results._rejected_anew()
    results.begin.value = "60; 130, 260"
    assert results.means() == [60.0, 130.0, 260.0]
    results.start = results.means()
    inside = ia.find_species(results.events(), start_kda=results.start, draws=0)
    line = export._commands().splitlines()[-1]
    assert ("--limit 21:7" in line) == rejects
    words = shlex.split(line)[1:]
    if rejects:
        words[1] = str(tmp_path / "standards.csv")
        Path(words[1]).write_bytes(export._csv())
    assert main([*words, "--draws", "0", "--json"]) == 0
    outside = pd.DataFrame(json.loads(capsys.readouterr().out)["species"])
    for column in ("mass_kda", "count", "fraction", "efficiency"):
        np.testing.assert_allclose(outside[column], inside.species[column], rtol=1e-6)
    alone = ia.find_species(results._seen, start_kda=results.start, draws=0)  # without its folder
    assert abs(alone.species["efficiency"].iloc[0] - inside.species["efficiency"].iloc[0]) > 1e-3


def test_masses_without_a_scale_are_contrasts_everywhere(standards: Path) -> None:
    chosen, queue = Chosen(result=uncalibrated(standards)), Queue()
    results, compare = Results(chosen), Compare(chosen, queue)
    export = Export(chosen, results, compare)
    for part in (results, export, compare):
        part.refresh()
    results.low.value, results.high.value = 3.0, 6.0
    results._add_gate()
    found = ia.find_species(results.events(), draws=0)
    results._take({"distribution": found.to_dict()}, results._seen, None)
    results._select()
    assert results.means() == pytest.approx(found.species["mass_kda"].tolist(), rel=1e-3)
    assert "contrast [10⁻³]" in results._species_table.object
    assert all("10⁻³" in text for text in results.which.options)
    assert export._gates().startswith(b"low,high,count")
    compare._paths.value = [str(standards)]
    assert compare.axis == "contrast [10⁻³]"
    with pytest.raises(ia.DataError, match="no masses"):
        compare._events()
    parts = [part for tab in (results, export, compare) for part in tab.body.select()]
    shown = [getattr(part, name, "") for part in parts for name in ("label", "object", "options")]
    asked = "Approximate masses [kDa]"  # of what is to bind, which somebody knows
    assert [text for text in map(str, shown) if "kDa" in text and text != asked] == []


def test_a_file_that_is_dropped_is_saved_once_and_replaces_nothing(tmp_path: Path) -> None:
    files = Files(Chosen(), tmp_path)
    files.refresh()
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((9, 8, 8), np.uint16))
    movie = (tmp_path / "a.tif").read_bytes()
    for name, said in (("b.tif", ""), ("../c.tif", ""), ("a.tif", "is in the folder already")):
        files._drop.value[name] = movie
        files._drop.param.trigger("value")
        assert (said or "nothing") in (files._notice.text or "nothing")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.tif", "b.tif", "c.tif"]
    assert (tmp_path / "c.tif").read_bytes() == movie


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
    run = queue.add(Job(tmp_path / "a.tif", tmp_path / "iscat.toml", tmp_path / "a.iscat"))
    assert queue.add(Job(tmp_path / "a.tif", None, tmp_path / "a.iscat")) is run
    assert run.job.command.startswith("iscat-fit ")
    assert f"--config {tmp_path / 'iscat.toml'}" in run.job.command
    camera = Job(tmp_path / "a.tif", None, tmp_path / "a.camera", "camera", dark=tmp_path / "d.tif")
    assert camera.command.startswith("iscat calibrate camera ")
    assert f"--dark {tmp_path / 'd.tif'}" in camera.command
    queue.stop(run)
    assert run.state == "stopped"
    assert queue.add(run.job) is not run


def test_a_process_that_cannot_start_is_said_in_its_row_and_the_others_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Red before: the queue's thread ended, and later runs waited for ever."""
    failures = iter([OSError("no room for a process"), MemoryError("nor for a pipe")])

    def get_context(kind: str) -> Any:
        for failure in failures:
            raise failure
        return multiprocessing.get_context(kind)

    monkeypatch.setattr("iscat_app.runs.get_context", get_context)
    queue = Queue()
    names = ("a", "b", "c")
    made = [queue.add(Job(tmp_path / f"{n}.tif", None, tmp_path / f"{n}.iscat")) for n in names]
    end = time.monotonic() + 60
    while not all(run.ended for run in made) and time.monotonic() < end:
        time.sleep(0.05)
    assert [run.state for run in made] == ["failed"] * 3
    assert made[0].log == ["the process could not be started: OSError: no room for a process"]
    assert made[1].log == ["the process could not be started: MemoryError: nor for a pipe"]
    assert "c.tif" in made[2].log[-1]  # which is not there
    queue.close()


def test_names_are_text_whatever_is_in_them(tmp_path: Path) -> None:
    (tmp_path / "<img src=x onerror=alert(1)>.tif").touch()
    (tmp_path / "b.iscat").mkdir()
    (tmp_path / "b.iscat" / "summary.json").write_text("{}", encoding="utf-8")
    assert [entry.kind for entry in listed(tmp_path)] == ["folder", "movie", "result"]
    assert "<img" not in table_of([("<img src=x>", "a")])
