"""A day of small movies: what is run, what is left alone, and what failing costs."""

from __future__ import annotations

import io
import json
import os
import shutil
import threading
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jsonschema
import numpy as np
import pandas as pd
import pytest
import tifffile
from event_tables import draw_series
from small_movies import SETUP, put_in_place_of_fits, simulate

import iscat_analysis as ia
from iscat_analysis.day import Batch, jobs
from iscat_analysis.day.compare import KD_COLUMNS
from iscat_analysis.day.gather import MOVIE_COLUMNS, SPECIES_COLUMNS
from iscat_analysis.day.jobs import STATE, Records
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.report.vega import figures_in
from iscat_analysis.schemas import schema, to_json
from iscat_cli import main
from iscat_cli.console import print_result
from iscat_cli.day import _lines as printed_lines

LINE = SETUP["calibration.gradient_per_kda"]
NAMES = ("a", "b", "c")


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """Simulate the movies once: three samples, and one that is cut short."""
    folder = tmp_path_factory.mktemp("made")
    for number, name in enumerate(NAMES):
        simulate(folder / f"{name}.tif", seed=number + 1)
    whole = (folder / "a.tif").read_bytes()
    (folder / "cut.tif").write_bytes(whole[: len(whole) // 2])
    return folder


@pytest.fixture(scope="module")
def done(made: Path, tmp_path_factory) -> Path:
    """Analyse the samples once."""
    folder = shutil.copytree(made, tmp_path_factory.mktemp("done") / "lab")
    _table(folder, NAMES)
    assert _run(folder).analysed == NAMES
    shutil.copytree(folder / "out" / "movies" / "a.iscat", folder.parent / "movie.iscat")
    return folder


@pytest.fixture
def finished(done: Path, tmp_path: Path) -> Path:
    """Return a copy of a folder whose samples are analysed."""
    return shutil.copytree(done, tmp_path / "lab")


@pytest.fixture
def quick(done: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every fit take a finished result."""
    put_in_place_of_fits(done.parent, monkeypatch)


@pytest.fixture
def lab(made: Path, tmp_path: Path) -> Path:
    """Return a folder with the movies and tables of them."""
    folder = shutil.copytree(made, tmp_path / "lab")
    _table(folder, NAMES)
    return folder


def _table(folder: Path, names: tuple[str, ...], name: str = "samples.csv") -> Path:
    lines = "".join(f"{n}.tif,{n},pH 7,{k + 1},{k},x\n" for k, n in enumerate(names))
    path = folder / name
    path.write_text(f"path,sample,condition,concentration_nm,batch,operator\n{lines}")
    return path


def _run(lab: Path, **options: object) -> Batch:
    given: dict = {"out": lab / "out", "config": SETUP, **options}
    return ia.batch(lab / "samples.csv", **given)


def _described(found: Batch) -> dict[str, Any]:
    """Check that a batch is as its schema says, and give it as JSON."""
    document = json.loads(to_json("batch", found.to_dict()))
    jsonschema.Draft202012Validator(schema("batch")).validate(document)
    return document


def test_every_movie_has_an_ordinary_result_and_the_day_its_tables(done: Path) -> None:
    found = _run(done)
    assert found.failed == ()
    for name in NAMES:
        folder = done / "out" / "movies" / f"{name}.iscat"
        assert len(pd.read_csv(folder / "fits.csv")) == 2
        assert (folder / "report.html").is_file()
    assert found.movies["movie"].tolist() == list(NAMES)
    assert found.movies["events"].tolist() == [2, 2, 2]
    assert found.movies["operator"].tolist() == ["x"] * 3
    assert found.movies["report"].tolist() == [f"movies/{n}.iscat/report.html" for n in NAMES]
    events = pd.read_parquet(done / "out" / "events.parquet")
    assert events["sample"].tolist() == [name for name in NAMES for _ in range(2)]
    assert events["concentration_nm"].tolist() == [1, 1, 2, 2, 3, 3]
    assert events["batch"].tolist() == [0, 0, 1, 1, 2, 2]
    alone = pd.read_parquet(done / "out" / "movies" / "b.iscat" / "fits.parquet")
    own = events[events["sample"] == "b"][list(alone.columns)].reset_index(drop=True)
    pd.testing.assert_frame_equal(own, alone, check_dtype=False)
    page = found.page.read_text(encoding="utf-8")
    assert 'href="movies/b.iscat/report.html"' in page


def test_the_schema_names_the_columns_of_the_tables() -> None:
    parts = schema("batch")["$defs"]
    assert tuple(parts["DaySpecies"]["properties"]) == SPECIES_COLUMNS
    assert set(parts["DayMovie"]["properties"]) == set(MOVIE_COLUMNS)
    assert tuple(parts["DayKd"]["properties"]) == KD_COLUMNS


def test_all_species_of_a_movie_are_printed(capsys) -> None:
    """Control: species of a movie without a scale of masses are contrasts, and none is in kDa."""
    states = {
        "sample": "s",
        "events": 27,
        "landings": 20,
        "state": "done",
        "why": "",
        "cautions": "",
    }
    movies = pd.DataFrame(
        [
            {"movie": "a", "answer": "Species of mass 67.1 · 148 kDa", **states},
            {"movie": "b", "answer": "Species of contrast 0.0021 · 0.0046", **states},
        ]
    )
    rows = [
        {
            "movie": movie,
            "mass_kda": mass,
            "mass_low": mass - 4,
            "mass_high": mass + 4,
            "count": 9.0,
        }
        | {"share": 0.4, "outlier": mass == 9.0}
        for movie in "ab"
        for mass in (9.0, 67.1, 148.0)
    ]
    found = SimpleNamespace(
        movies=movies, species=pd.DataFrame(rows), kd=pd.DataFrame({"why": []}), analysed=(),
        out=Path("day"), page=Path("day/batch.html"),
    )  # fmt: skip
    for line in printed_lines(found):
        print_result(line)
    said = capsys.readouterr().out
    assert "67.1 kDa (63.1 to 71.1): 9, 40 %" in said
    assert "148 kDa (144 to 152): 9, 40 %" in said
    assert "Species of contrast 0.0021 · 0.0046" in said
    assert said.count("kDa (") == 2


def test_a_batch_is_printed_as_one_object(done: Path, capsys, tmp_path: Path) -> None:
    setup = tmp_path / "setup.toml"
    setup.write_text(ia.config_to_toml(ia.configure(SETUP)), encoding="utf-8")
    command = ["batch", str(done / "samples.csv"), "--out", str(done / "out")]
    assert main([*command, "--config", str(setup), "--json", "--quiet"]) == 0
    printed = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert printed == _described(_run(done))
    assert [movie["events"] for movie in printed["movies"]] == [2, 2, 2]
    assert printed["movies"][1]["operator"] == "x"
    assert printed["page"] == str(done / "out" / "batch.html")
    part = _described(_run(done, only=(1, 2)))
    assert [movie["movie"] for movie in part["movies"]] == ["a", "c"]
    early = _described(_run(done, out=tmp_path / "new", merge=True))
    assert early["failed"][0] == {"name": "a", "why": "not analysed yet"}
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.Draft202012Validator(schema("batch")).validate({**printed, "failed": ["a"]})


@pytest.mark.usefixtures("quick")
def test_only_what_has_changed_is_analysed_again(finished: Path) -> None:
    _run(finished)  # the page tells where the table lies
    page = finished / "out" / "batch.html"
    before = page.stat().st_mtime_ns
    assert _run(finished).analysed == ()
    assert page.stat().st_mtime_ns == before
    assert _run(finished, settings={"compute.workers": 1}).analysed == ()
    os.utime(finished / "b.tif")  # copied: another time, the same bytes
    assert _run(finished).analysed == ()

    table = finished / "samples.csv"
    table.write_text(table.read_text().replace("b.tif,b,pH 7", "b.tif,renamed,pH 9"))
    again = _run(finished)
    assert (again.analysed, again.movies["sample"].tolist()) == ((), ["a", "renamed", "c"])

    (finished / "out" / STATE / "movies" / "b.json").write_text("{")
    assert _run(finished).analysed == ("b",)  # a damaged record
    simulate(finished / "b.tif.new", seed=7)
    (finished / "b.tif.new").replace(finished / "b.tif")
    assert _run(finished).analysed == ("b",)
    simulate(finished / "d.tif", seed=9)
    _table(finished, (*NAMES, "d"))
    again = _run(finished)
    assert (again.analysed, len(again.movies)) == (("d",), 4)


def test_a_changed_configuration_analyses_all_and_a_changed_row_its_movie(finished: Path) -> None:
    assert _run(finished, settings={"fit.roi_nm": 2000.0}).analysed == NAMES
    lines = "path,sample,fit.roi_nm\na.tif,a,\nb.tif,b,1900\nc.tif,c,\n"
    (finished / "samples.csv").write_text(lines)
    assert _run(finished, settings={"fit.roi_nm": 2000.0}).analysed == ("b",)
    config = ia.load_config(finished / "out" / "movies" / "b.iscat" / "config.toml")
    assert config.fit.roi_nm == 1900.0


@pytest.mark.usefixtures("quick")
def test_a_movie_that_fails_costs_only_itself(lab: Path, capsys, tmp_path: Path) -> None:
    _table(lab, ("a", "cut", "b"))
    setup = tmp_path / "setup.toml"
    setup.write_text(ia.config_to_toml(ia.configure(SETUP)), encoding="utf-8")
    command = ["batch", str(lab / "samples.csv"), "--out", str(lab / "out")]
    assert main([*command, "--config", str(setup), "--quiet"]) == 3
    said = capsys.readouterr()
    (line,) = said.err.splitlines()
    assert line.startswith("iscat batch: error: cut: ")
    assert "2 of 3 movies done, 3 of them now" in said.out
    movies = pd.read_csv(lab / "out" / "movies.csv")
    assert movies["state"].tolist() == ["done", "failed", "done"]
    assert "cut.tif" in movies["why"][1]
    assert movies["why"][1] in (lab / "out" / "batch.html").read_text(encoding="utf-8")
    assert not (lab / "out" / "movies" / "cut.iscat").exists()
    (lab / "cut.tif").write_bytes((lab / "c.tif").read_bytes())  # copied again
    assert _run(lab).analysed == ("cut",)


def _failing(error: BaseException, name: str) -> Callable[..., object]:
    """Give what raises an error in the place of the fit of one movie."""
    real = jobs.fit_stack

    def fit(stack: Path, *arguments: object, **options: object) -> object:
        if stack.name == name:
            raise error
        return real(stack, *arguments, **options)  # type: ignore[arg-type]

    return fit


@pytest.mark.usefixtures("quick")
def test_an_unexpected_error_costs_only_its_movie(lab: Path, monkeypatch) -> None:
    monkeypatch.setattr(jobs, "fit_stack", _failing(ZeroDivisionError("by chance"), "b.tif"))
    assert _run(lab).failed == (("b", "unexpected ZeroDivisionError: by chance"),)


@pytest.mark.usefixtures("quick")
def test_an_interrupt_keeps_what_is_finished(lab: Path, monkeypatch) -> None:
    """One that reached compiled code is hidden in an error of its own."""
    hidden = SystemError("returned a result with an exception set")
    hidden.__cause__ = KeyboardInterrupt()
    for error in (KeyboardInterrupt(), hidden):
        with monkeypatch.context() as patch:
            patch.setattr(jobs, "fit_stack", _failing(error, "b.tif"))
            with pytest.raises(KeyboardInterrupt, match="1 of 3 movies are finished"):
                _run(lab)
    assert _run(lab).analysed == ("b", "c")


def test_a_result_that_was_interrupted_under_another_configuration_is_not_taken(
    finished: Path, monkeypatch
) -> None:
    """Back at the first configuration, the folder holds what the second one left."""

    def stopped(*_: object, out: Path, **__: object) -> None:
        (out / "summary.json").write_text('{"interrupted": true}')
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(jobs, "fit_stack", stopped)
        with pytest.raises(KeyboardInterrupt):
            _run(finished, settings={"fit.roi_nm": 2000.0})
    assert _run(finished).analysed == ("a",)


def test_a_day_on_which_everything_failed_has_a_page(lab: Path) -> None:
    _table(lab, ("cut",))
    found = _run(lab)
    assert [name for name, _ in found.failed] == ["cut"]
    assert "not analysed" in found.page.read_text(encoding="utf-8")
    assert len(pd.read_parquet(lab / "out" / "events.parquet")) == 0
    assert found.species.empty


# ---- K_D ----------------------------------------------------------------------------------------


def _fill(lab: Path, tables: list[pd.DataFrame]) -> None:
    """Give the results of the three movies events of one's own."""
    for name, table in zip(NAMES, tables, strict=True):
        path = lab / "out" / "movies" / f"{name}.iscat" / "fits.parquet"
        columns = pd.read_parquet(path).columns
        whole = table.assign(status="ok", p_value=0.5).reindex(columns=columns)
        whole.to_parquet(path)


def test_a_series_of_concentrations_has_its_equilibrium(finished: Path, capsys) -> None:
    totals = np.array([[1.0], [2.0], [3.0]])
    drawn = draw_series(np.random.default_rng(3), "dimer", totals, 2.0, [66.0], number=1500)
    _fill(finished, drawn)
    found = _run(finished, kd="dimer", kd_masses_kda=[66])
    assert (found.failed, found.analysed) == ((), ())
    row = found.kd.iloc[0]
    assert _described(found)["kd"][0]["kd_nm"] == row["kd_nm"]
    assert (row["condition"], row["movies"], row["model"]) == ("pH 7", 3, "dimer")
    assert row["kd_low"] < 2.0 < row["kd_high"] < 2.3 * row["kd_low"]  # the exponent is free
    assert row["p_value"] > 1e-3
    page = found.page.read_text(encoding="utf-8")
    assert "K_D, pH 7" in page
    assert {"kd-1", "profile-1"} <= set(figures_in(found.page))

    # The tables alone say the same.
    alone = ia.fit_kd(finished / "out" / "movies.csv", model="dimer", masses_kda=[66])
    assert alone.fit.kd_nm == pytest.approx(row["kd_nm"], rel=1e-6)

    config = finished / "out" / "movies" / "a.iscat" / "config.toml"
    command = ["batch", finished / "samples.csv", "--out", finished / "out", "--config", config]
    assert main([*map(str, command), "--kd", "dimer", "--kd-masses", "66"]) == 0
    assert f"K_D of pH 7 = {row['kd_nm']:.4g} nM" in capsys.readouterr().out
    assert not len(_run(finished).kd)
    assert not (finished / "out" / "kd.csv").exists()


def _partly_told(finished: Path, *few: int) -> str:
    """Give some movies few events and add one that is damaged; give the line on K_D."""
    totals = np.array([[1.0], [2.0], [3.0]])
    drawn = draw_series(np.random.default_rng(3), "dimer", totals, 2.0, [66.0], number=1500)
    _fill(finished, [t.head(2) if k in few else t for k, t in enumerate(drawn)])
    _table(finished, (*NAMES, "cut"))
    config = finished / "out" / "movies" / "a.iscat" / "config.toml"
    command = ["batch", finished / "samples.csv", "--out", finished / "out", "--config", config]
    with redirect_stdout(io.StringIO()) as out:
        assert main([*map(str, command), "--kd", "dimer", "--kd-masses", "66"]) == 3
    (line,) = [line for line in out.getvalue().splitlines() if line.startswith("K_D")]
    return line


def test_movies_that_tell_nothing_are_left_out_of_an_equilibrium_and_named(finished: Path) -> None:
    """One is damaged and one has few events; the table of the batch gives the same alone."""
    line = _partly_told(finished, 1)
    assert "2 movies, p = " in line
    assert "left out, with less than 10 events: b" in line
    table = finished / "out" / "movies.csv"
    alone = ia.fit_kd(table, model="dimer", masses_kda=[66])
    of_day = pd.read_csv(finished / "out" / "kd.csv")
    assert alone.fit.kd_nm == pytest.approx(of_day["kd_nm"][0], rel=1e-6)
    assert alone.notes[0] == "left out, not analysed: cut"
    assert "less than 10 events" in alone.notes[1]
    rows = pd.read_csv(table)
    rows.assign(concentration_nm=[1, None, 3, 4]).to_csv(table, index=False)
    alone = ia.fit_kd(table, model="dimer", masses_kda=[66])
    assert alone.notes[1] == "left out, without concentration_nm: b"
    rows.assign(report=None).to_csv(table, index=False)
    with pytest.raises(DataError, match="no sample that is analysed"):
        ia.fit_kd(table, model="dimer", masses_kda=[66])
    line = _partly_told(finished, 0, 1)
    assert "1 movie; left out" in line
    assert "a single table the model cannot be tested" in line
    assert "nan" not in line


def test_what_is_no_series_says_why_it_has_no_equilibrium(finished: Path) -> None:
    asked = _run(finished, kd="dimer")
    ((what, why),) = asked.failed
    assert what == "K_D of pH 7"
    assert "no movie has" in why
    assert "no movie has" in asked.page.read_text(encoding="utf-8")
    assert _run(finished, kd="dimer").failed == asked.failed  # read back, not fitted again
    ((what, why),) = _run(finished, kd="ab", kd_masses_kda=(40, 80)).failed
    assert (what, "a_nm and b_nm" in why) == ("K_D", True)


def test_heights_have_no_species(lab: Path) -> None:
    found = _run(lab, settings={"fit.mode": "localize", "fit.z_range_nm": [0.0, 300.0]})
    assert found.movies["state"].tolist() == ["done"] * 3
    assert found.species.empty
    assert len(pd.read_parquet(lab / "out" / "events.parquet")) > 0


def _tables(out: Path) -> dict[str, bytes]:
    names = ("movies.csv", "species.csv", "shifts.csv", "events.parquet", "batch.html")
    fits = {p.relative_to(out).as_posix(): p.read_bytes() for p in out.rglob("fits.csv")}
    return {name: (out / name).read_bytes() for name in names} | fits


def test_parts_give_the_bytes_of_one_run(finished: Path) -> None:
    parts = {"out": finished / "parts"}
    assert _run(finished, **parts, only=(2, 2)).analysed == ("b",)
    early = _run(finished, **parts, merge=True)
    assert early.failed == (("a", "not analysed yet"), ("c", "not analysed yet"))
    assert _run(finished, **parts, only=(1, 2)).analysed == ("a", "c")
    assert _run(finished, **parts, only=(9, 9)).analysed == ()  # more parts than movies
    assert _run(finished, **parts, merge=True).failed == ()
    assert _tables(finished / "parts") == _tables(finished / "out")


def test_what_is_wrong_is_refused_before_anything_is_written(lab: Path, capsys) -> None:
    command = ["batch", str(lab / "samples.csv"), "--out", str(lab / "out")]
    for text in ("3/2", "0/2", "x", "1"):
        assert main([*command, "--only", text]) == 2
        assert "write it as K/N" in capsys.readouterr().err
    assert main([*command, "--only", "1/2", "--merge"]) == 2
    assert "merged when all are" in capsys.readouterr().err
    for given, said in (
        ({"kd": "trimer"}, "`kd`"),
        ({"kd": "ab"}, "`kd_masses_kda`"),
        ({"kd": "dimer", "kd_masses_kda": [-66]}, "`kd_masses_kda`"),
        ({"kd_masses_kda": [66]}, "give `kd`"),
    ):
        with pytest.raises(ConfigError, match=said):
            _run(lab, **given)
    with pytest.raises(DataError, match=r"is no earlier batch"):
        _run(lab, out=lab)
    (lab / "file").write_text("mine")
    with pytest.raises(DataError, match="is a file"):
        _run(lab, out=lab / "file")
    (lab / "samples.csv").write_text("path,role\na.tif,smaple\n")
    assert main(command) == 2
    assert "line 2, role" in capsys.readouterr().err
    assert not (lab / "out").exists()


def test_a_job_is_done_by_one_run_at_a_time(tmp_path: Path) -> None:
    first, second = Records(tmp_path), Records(tmp_path)
    order: list[str] = []
    told: list[str] = []
    inside = threading.Event()

    def other() -> None:
        inside.wait(10)
        with second.held("job", told.append):
            order.append("second")

    thread = threading.Thread(target=other)
    with first.held("job", told.append):
        thread.start()
        inside.set()
        thread.join(2.6)
        assert thread.is_alive()
        order.append("first")
    thread.join(10)
    assert order == ["first", "second"]
    assert told == ["waiting for another run, which is at job"]


# ---- calibrations of the day -----------------------------------------------------------------

STANDARDS = (600.0, 1200.0, 2400.0)


@pytest.fixture(scope="module")
def day(tmp_path_factory) -> Path:
    """Make a day: a flat, a calibrant of three standards, a sample."""
    folder = tmp_path_factory.mktemp("day")
    simulate(folder / "standards.tif", seed=4, masses=12 * STANDARDS)
    simulate(folder / "sample.tif", seed=5)
    random = np.random.default_rng(6)
    level = np.linspace(2e3, 2e4, 64)
    flat = random.poisson(level, (60, 64, 64))  # its gain is one photoelectron per count
    tifffile.imwrite(folder / "flat.tif", flat.astype("uint16"))
    (folder / "samples.csv").write_text(
        "path,role,standards\nsample.tif,sample,\nflat.tif,flat,\n"
        "standards.tif,calibrant,600 1200 2400\n"
    )
    _calibrated(folder)
    return folder


def _calibrated(day: Path, **options: object) -> Batch:
    setup = {key: value for key, value in SETUP.items() if not key.startswith("calibration")}
    setup |= {"camera.offset_adu": 0.0, "fit.spheres": ()}  # without a scale, all look large
    given: dict = {"out": day / "out", "config": setup, **options}
    return ia.batch(day / "samples.csv", **given)


def _afresh(day: Path, tmp_path: Path) -> Path:
    """Copy the movies of a day without its results."""
    return shutil.copytree(day, tmp_path / "day", ignore=shutil.ignore_patterns("out"))


def test_the_day_is_calibrated_before_its_samples(day: Path) -> None:
    found = _calibrated(day)
    assert (found.failed, found.analysed) == ((), ())
    config = ia.load_config(day / "out" / "movies" / "sample.iscat" / "config.toml")
    camera = json.loads((day / "out" / "calibration" / "camera" / "camera.json").read_text())
    low, high = camera["gain_e_per_adu"]["ci95"]
    assert config.camera.gain_e_per_adu == pytest.approx(
        camera["gain_e_per_adu"]["value"], rel=1e-5
    )
    assert low - (high - low) < 1.0 < high + (high - low)
    line = json.loads((day / "out" / "calibration" / "mass" / "calibration.json").read_text())
    assert config.calibration is not None
    assert config.calibration.gradient_per_kda == pytest.approx(line["gradient_per_kda"], rel=1e-5)
    assert abs(line["gradient_per_kda"] - LINE) < 5 * line["gradient_se"]
    rows = found.movies.set_index("movie")
    assert rows.loc["standards", "standards_seen"] == "3 of 3"
    assert len(_described(found)["species"]) == len(found.species) > 0
    assert rows.loc["sample", "mass_scale"] == "of the day"
    assert rows.loc["flat", "state"] == "done"
    fits = pd.read_csv(day / "out" / "movies" / "sample.iscat" / "fits.csv").sort_values("mass_kda")
    error = np.hypot(fits["sigma_mass_kda"], fits["systematic_mass_kda"])
    assert (np.abs(fits["mass_kda"] - [900.0, 1500.0]) < 5 * error).all()


@pytest.mark.large
def test_a_changed_calibrant_analyses_what_depends_on_it(day: Path, tmp_path: Path) -> None:
    lab = shutil.copytree(day, tmp_path / "day")
    simulate(lab / "new.tif", seed=8, masses=12 * STANDARDS)
    (lab / "new.tif").replace(lab / "standards.tif")
    assert set(_calibrated(lab).analysed) == {"sample", "standards"}
    assert _calibrated(lab).analysed == ()


def test_a_calibrant_that_fails_leaves_the_scale_as_configured_and_says_so(
    day: Path, tmp_path: Path
) -> None:
    lab = _afresh(day, tmp_path)
    (lab / "standards.tif").write_bytes((lab / "standards.tif").read_bytes()[:5000])
    (lab / "flat.tif").write_bytes(b"II*\0")
    found = _calibrated(lab)
    assert [name for name, _ in found.failed] == [
        "calibration of the camera", "calibration of the mass", "flat", "standards",
    ]  # fmt: skip
    rows = found.movies.set_index("movie")
    assert rows.loc["sample", "state"] == "done"
    assert "mass scale: none" in rows.loc["sample", "cautions"]
    configured = _calibrated(lab, settings={"calibration.gradient_per_kda": LINE})
    cautions = configured.movies.set_index("movie").loc["sample", "cautions"]
    assert "as configured, because the day's calibration failed" in cautions


@pytest.mark.large
def test_calibrants_of_the_other_sign_say_what_of_the_configuration_is_wrong(
    day: Path, tmp_path: Path
) -> None:
    """A batch has no option that says how particles land."""
    lab = _afresh(day, tmp_path)
    found = _calibrated(lab, settings={"optics.reference_phase_deg": 180.0})
    ((what, why),) = found.failed
    assert what == "calibration of the mass"
    assert "if your particles land dark, correct the sign of calibration.gradient_per_kda" in why
    assert "`landing`" not in why


@pytest.mark.large  # others give the bytes of one run with calibrations that are there
def test_parts_share_the_calibrations(day: Path, tmp_path: Path) -> None:
    lab = _afresh(day, tmp_path)
    parts = [
        threading.Thread(target=_calibrated, args=(lab,), kwargs={"only": (k, 2)}) for k in (1, 2)
    ]
    for part in parts:
        part.start()
    for part in parts:
        part.join()
    assert _calibrated(lab, merge=True).failed == ()
    names = ("movies.csv", "species.csv", "events.parquet", "batch.html")
    for name in names:
        assert (lab / "out" / name).read_bytes() == (day / "out" / name).read_bytes(), name
