"""The table of a day in its three forms, and what is said of one that is wrong."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from iscat_analysis.config import configure
from iscat_analysis.day.table import configured, make_plan, part_of, read_standards, read_table
from iscat_analysis.errors import ConfigError

HEADING = "path,sample,condition,concentration_nm,replicate,role,standards,fit.roi_nm,operator\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder of files that are movies by their names."""
    (tmp_path / "more").mkdir()
    for name in ("a.tif", "b.tif", "c.mp", "more/a.tif", "notes.txt", ".hidden.tif"):
        (tmp_path / name).write_bytes(b"II*\0")
    return tmp_path


def _csv(folder: Path, text: str, encoding: str = "utf-8") -> Path:
    path = folder / "samples.csv"
    path.write_text(text, encoding=encoding)
    return path


def test_csv_keeps_every_column(folder: Path) -> None:
    lines = "a.tif,BSA,pH 7,12.5,2,Calibrant,66;132:2,900,AB\nmore/a.tif,,,,,,,,\n"
    first, second = read_table(_csv(folder, HEADING + lines)).rows
    assert (first.sample, first.condition, first.replicate) == ("BSA", "pH 7", "2")
    assert (first.concentration_nm, first.role) == (12.5, "calibrant")
    assert first.standards == ((66.0, 0.66), (132.0, 2.0))
    assert first.settings == ("fit.roi_nm=900",)
    assert first.further == {"operator": "AB"}
    assert first.path == (folder / "a.tif").resolve()
    assert (second.sample, second.role, second.settings) == ("a", "sample", ())
    assert math.isnan(second.concentration_nm)


@pytest.mark.parametrize("delimiter", [";", "\t"])
def test_csv_as_spreadsheets_write_it(folder: Path, delimiter: str) -> None:
    text = "Path,Role\n\n# a remark\na.tif,blank\nb.tif\n".replace(",", delimiter)
    rows = read_table(_csv(folder, text, "utf-8-sig")).rows
    expected = [("a.tif", "blank", "line 4"), ("b.tif", "sample", "line 5")]
    assert [(row.given, row.role, row.where) for row in rows] == expected


def test_toml_is_the_same_table(folder: Path) -> None:
    path = folder / "samples.toml"
    path.write_text(
        '[[movies]]\npath = "a.tif"\nsample = "BSA"\nconcentration_nm = 12.5\nreplicate = 2\n'
        'role = "calibrant"\nstandards = [66, 132]\nfit = { roi_nm = 900.0 }\noperator = "AB"\n'
        '[[movies]]\npath = "b.tif"\n"background.frames" = [0, 20]\n',
        encoding="utf-8",
    )
    first, second = read_table(path).rows
    assert (first.sample, first.replicate, first.role) == ("BSA", "2", "calibrant")
    assert first.standards == ((66.0, 0.66), (132.0, 1.32))
    assert first.further == {"operator": "AB"}
    assert configured(configure(), {}, first).fit.roi_nm == 900.0
    assert configured(configure(), {}, second).background.frames == (0, 20)


def test_the_movies_of_a_folder_are_samples_named_by_their_files(folder: Path) -> None:
    rows = read_table(folder).rows
    assert [(row.sample, row.role) for row in rows] == [(n, "sample") for n in "abc"]
    with pytest.raises(ConfigError, match="holds no movie"):
        read_table(_empty(folder))


def _empty(folder: Path) -> Path:
    (folder / "empty").mkdir()
    return folder / "empty"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("sample,role\na,blank\n", "the heading lacks the column path"),
        ("path,role\na.tif,smaple\n", "line 2, role: 'smaple' is none of sample, calibrant"),
        ("path,role\na.tif,smaple\n", "did you mean sample?"),
        ("path\na.tif\nz.tif\n", "line 3, path: z.tif: there is no such file"),
        ("path\nmore\n", "line 2, path: more: is a folder"),
        ("path\na.tif\nb.tif\n./a.tif\n", "line 4, path: ./a.tif is the movie of line 2 already"),
        ("path,sample\n,a\n", "line 2, path: is empty"),
        ("path,conditon\na.tif,x\n", "the column conditon: did you mean condition?"),
        ("path,concentration_um\na.tif,x\n", "did you mean concentration_nm?"),
        ("path,sample,sample\na.tif,x,y\n", "names the column sample twice"),
        ("path,concentration_nm\na.tif,ten\n", "line 2, concentration_nm: 'ten' is not"),
        ("path,concentration_nm\na.tif,-1\n", "line 2, concentration_nm: '-1' is not"),
        ("path,role,standards\na.tif,calibrant,x\n", "line 2, standards: 'x' is not a mass"),
        ("path,standards\na.tif,66\n", "line 2, standards: are of a calibrant"),
        ("path,sample\na.tif,b,c\n", "line 2 has 3 cells, but the heading names 2"),
        ("path\n", "it lists no movie"),
    ],
)
def test_a_wrong_table_is_told_by_row_and_column(folder: Path, text: str, said: str) -> None:
    with pytest.raises(ConfigError) as told:
        read_table(_csv(folder, text))
    assert said in str(told.value)
    assert "\n" not in str(told.value)
    assert str(folder / "samples.csv") in str(told.value)


def test_all_that_is_wrong_is_told_at_once(folder: Path) -> None:
    lines = "".join(f"{n}.tif,x\n" for n in range(4))
    with pytest.raises(ConfigError) as told:
        read_table(_csv(folder, f"path,role\n{lines}"))
    assert "line 2, path" in str(told.value)
    assert str(told.value).endswith("; and 3 more")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("movies = 3\n", "is not a list of movies"),
        ("[optics]\nna = 1.3\n", "has 'optics'"),
        ("[[movies]]\nsample = 3\n", "[[movies]] number 1 lacks the column path"),
        ("[[movies\n", "is not valid TOML"),
    ],
)
def test_a_wrong_toml_table(folder: Path, text: str, said: str) -> None:
    path = folder / "samples.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as told:
        read_table(path)
    assert said in str(told.value)


def test_files_that_are_no_table(folder: Path) -> None:
    with pytest.raises(ConfigError, match="no such table or folder"):
        read_table(folder / "absent.csv")
    (folder / "noise.csv").write_bytes(b"path,\x00\x81\n")
    with pytest.raises(ConfigError, match="is not a text file"):
        read_table(folder / "noise.csv")


@pytest.mark.parametrize("encoding", ["cp1252", "utf-8-sig", "utf-16", "utf-16-le"])
def test_a_table_as_spreadsheets_save_it(folder: Path, encoding: str) -> None:
    path = folder / "excel.csv"
    path.write_bytes("sep=;\r\npath;Größe\r\na.tif;1,5\r\n".encode(encoding))
    (row,) = read_table(path).rows
    assert (row.given, row.further) == ("a.tif", {"Größe": "1,5"})


def test_standards_are_masses() -> None:
    assert read_standards([66, 146.0]) == ((66.0, 0.66), (146.0, 1.46))
    assert read_standards("66:1, 480") == ((66.0, 1.0), (480.0, 4.8))
    for wrong in ("66,-3", "nan", "66:x", "inf"):
        with pytest.raises(ValueError, match="is not a mass"):
            read_standards(wrong)


def test_a_plan_names_results_apart_and_does_not_depend_on_the_order(folder: Path) -> None:
    (folder / "a.mp").write_bytes(b"II*\0")
    names = ["a.tif", "a.mp", "more/a.tif", "b.tif"]
    plans = [
        make_plan(read_table(_csv(folder, "path\n" + "\n".join(order))), configure())
        for order in (names, names[::-1])
    ]
    assert [m.name for m in plans[0].movies] == ["a-mp", "a-tif", "b", "more/a"]
    assert plans[0].movies == tuple(
        type(m)(m.name, type(m.row)(**{**vars(m.row), "where": n.row.where}))
        for m, n in zip(plans[1].movies, plans[0].movies, strict=True)
    )
    parts = [part_of(plans[0].movies, (k, 3)) for k in (1, 2, 3)]
    assert sorted(m.name for part in parts for m in part) == [m.name for m in plans[0].movies]


def test_movies_beside_each_other_elsewhere_are_told_apart_by_their_folders(
    folder: Path, tmp_path_factory
) -> None:
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    for day in ("monday", "tuesday"):
        (elsewhere / day).mkdir()
        (elsewhere / day / "x.tif").write_bytes(b"II*\0")
    rows = "\n".join(str(elsewhere / day / "x.tif") for day in ("monday", "tuesday"))
    plan = make_plan(read_table(_csv(folder, f"path\n{rows}\nb.tif\n")), configure())
    assert [m.name for m in plan.movies] == ["b", "monday/x", "tuesday/x"]


def test_settings_of_a_row_are_checked_before_any_work(folder: Path) -> None:
    with pytest.raises(ConfigError, match=r"line 2: .*optics.nna.*did you mean"):
        make_plan(read_table(_csv(folder, "path,optics.nna\na.tif,1.3\n")), configure())
    with pytest.raises(ConfigError, match="no movie has the role calibrant"):
        make_plan(read_table(_csv(folder, "path\na.tif\n")), configure(), ((66.0, 0.66),))


def test_the_table_wins_over_the_day_and_the_day_over_the_configuration(folder: Path) -> None:
    row = read_table(_csv(folder, "path,optics.na\na.tif,1.3\n")).rows[0]
    day = {"optics.na": 1.35, "camera.gain_e_per_adu": 4.2}
    found = configured(configure(settings={"optics.na": 1.4}), day, row)
    assert (found.optics.na, found.camera.gain_e_per_adu) == (1.3, 4.2)
