"""Tables as programs and spreadsheets save them: one reader takes all of them for the same."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import iscat_analysis as ia
from iscat_analysis.movie.tables import read_events, read_frame
from iscat_analysis.species.tables import event_table
from iscat_cli import main

MASSES = [60.07, 1146.25, 480.5]

SAVED = {
    "one column": "masses_kDa\n60.070\n1146.250\n480.500\n",
    "one column, decimal commas": "masses_kDa\n60,070\n1146,250\n480,500\n",
    "decimal commas in quotes": 'frame,masses_kDa\n1,"60,070"\n2,"1146,250"\n3,"480,5"\n',
    "semicolons": "frame;mass_kda\n1;60,07\n2;1146,25\n3;480,5\n",
    "semicolons and points": "frame;mass_kda\n1;60.07\n2;1146.25\n3;480.5\n",
    "thousands with points": "frame;mass_kda\n1;60,07\n2;1.146,25\n3;480,5\n",
    "thousands with commas": 'frame,mass_kda\n1,60.07\n2,"1,146.25"\n3,480.5\n',
    "thousands with spaces": "frame;mass_kda\n1;60,07\n2;1\u202f146,25\n3;480,5\n",
    "thousands with apostrophes": "frame;mass_kda\n1;60.07\n2;1'146.25\n3;480.5\n",
    "tabs": "frame\tmass_kda\n1\t60.07\n2\t1146.25\n3\t480.5\n",
    "the line of Excel": "sep=;\nframe;mass_kda\n1;60,07\n2;1146,25\n3;480,5\n",
    "line ends of a Mac": "frame,mass_kda\r1,60.07\r2,1146.25\r3,480.5\r",
    "a heading with its unit": "Mass [kDa],Contrast [%]\n60.07,-1\n1146.25,-2\n480.5,-3\n",
    "dalton": "Mass (Da)\n60070\n1146250\n480500\n",
    "dalton in thousands": 'mass_da\n"60,070"\n"1,146,250"\n"480,500"\n',
    "a row of units": "frame,mass_kda\n-,kDa\n1,60.07\n2,1146.25\n3,480.5\n",
    "a row of units that begins with #": "frame,mass_kda\n#,kDa\n1,60.07\n2,1146.25\n3,480.5\n",
    "units in a row alone": "Frame\tMass\n\tDa\n1\t60070\n2\t1146250\n3\t480500\n",
    "a heading in a comment": "# frame,mass_kda\n1,60.07\n2,1146.25\n3,480.5\n",
    "comments": "# made, by hand\nframe,mass_kda\n1,60.07\n2,1146.25\n3,480.5\n# 3 events\n",
    "empty cells at the end": "frame,mass_kda,\n1,60.07,\n2,1146.25,\n3,480.5,\n,,\n",
    "Masse": "Größe;Masse [kDa]\n1;60,07\n2;1146,25\n3;480,5\n",
}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
@pytest.mark.parametrize("name", SAVED)
def test_a_table_is_the_same_however_it_is_saved(name: str, encoding: str, tmp_path: Path) -> None:
    path = tmp_path / "events.csv"
    path.write_bytes(SAVED[name].encode(encoding))
    np.testing.assert_allclose(read_events(path)["mass_kda"], MASSES, rtol=1e-12)


def test_windows_without_unicode(tmp_path: Path) -> None:
    path = tmp_path / "events.csv"
    path.write_bytes(SAVED["Masse"].encode("cp1252"))
    assert read_events(path)["mass_kda"].tolist() == MASSES


def test_cells_without_a_number_are_empty(tmp_path: Path) -> None:
    words = ["", "n/a", "NaN", "#NUM!", "#DIV/0!", "-", "inf", "1.797e308", "1.#QNAN"]
    path = tmp_path / "events.csv"
    path.write_text("mass_kda,contrast\n" + "".join(f"{word},1\n" for word in words) + "66.5,1\n")
    mass = read_events(path)["mass_kda"].to_numpy()
    assert np.isnan(mass[:-1]).all()
    assert mass[-1] == 66.5


def test_another_column_decides_what_a_column_leaves_open(tmp_path: Path) -> None:
    """Whether 1.020 and 1,020 are small depends on the table; a note says what is assumed."""
    path = tmp_path / "events.csv"
    for text, mass, said in (
        ("mass_kda;x_px\n1.020;12,5\n", 1020.0, 0),
        ("mass_kda;x_px\n1.020;12.5\n", 1.02, 0),
        ("mass_kda;x_px\n1.020;12.512\n", 1.02, 0),
        ("mass_da;x_px\n66.020;12\n", 66.02, 0),
        ('mass_kda,x_px\n"1,020",12.5\n', 1020.0, 0),
        ('mass_kda\n"1,020"\n"980"\n', 1020.0, 0),
        ('mass_kda\n"1,020"\n"0,980"\n', 1.02, 0),
        ('mass_kda\n"1,020"\n"1,980"\n', 1.02, 1),
    ):
        path.write_text(text)
        table = read_events(path)
        assert table["mass_kda"][0] == pytest.approx(mass), text
        assert len(table.attrs["notes"]) == said, text


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("frame,mass_kda\n1,66,5\n2,132,4\n", "row 0 has 3 values .* semicolons"),
        ("frame,mass_kda\n1,66.5\n2\n", "row 1 has 1 values .* interrupted"),
        ("frame,mass\n1,66.5\n", "does not say the unit of its masses"),
        ("mass_kda,Mass [kDa]\n66,66\n", "two columns of the name"),
        ("frame,mass_kda\n1,66\n2,heavy\n", "holds 'heavy' in mass_kda in row 1"),
        ("mass_kda\n66.5.1\n", "holds '66.5.1' in mass_kda"),
    ],
)
def test_what_is_no_table_is_refused_in_words(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "events.csv"
    path.write_text(text)
    with pytest.raises(ia.DataError, match=said):
        read_events(path)


@pytest.mark.parametrize(
    ("heading", "times", "said"),
    [("masses_kDa", 1000.0, "heavier than .* name their column mass_da"),
     ("mass_da", 1.0, "lighter than .* name their column mass_kda"), ("mass_kda", 1.0, "")],
)  # fmt: skip
def test_masses_under_the_heading_of_another_unit_are_noticed(
    heading: str, times: float, said: str, tmp_path: Path, capsys
) -> None:
    path = tmp_path / "events.csv"
    mass = np.random.default_rng(1).normal(100.0, 9.0, 60)
    pd.DataFrame({heading: times * mass}).to_csv(path, index=False)
    assert main(["species", str(path), "--k", "1", "--draws", "0"]) == 0
    error = capsys.readouterr().err
    noticed = [line for line in error.splitlines() if "name their column" in line]
    assert len(noticed) == bool(said)
    if said:
        assert pytest.approx(1, abs=0.1) == event_table(path).mass_kda.mean() / (
            1e5 if times > 1 else 0.1
        )


def test_a_table_in_memory_has_the_same_names() -> None:
    table = pd.DataFrame({"Mass [Da]": [66e3, 132e3], "Contrast": [-0.001, -0.002]})
    assert event_table(table).mass_kda.tolist() == [66.0, 132.0]


def test_tables_of_samples_keep_their_texts(tmp_path: Path) -> None:
    path = tmp_path / "samples.csv"
    path.write_bytes(
        "sep=;\npath;concentration_nm;day\na.csv;1,5;3\nb, c.csv;;4\n".encode("utf-16")
    )
    table = read_frame(path)
    assert table["path"].tolist() == ["a.csv", "b, c.csv"]
    assert table["concentration_nm"].tolist()[0] == 1.5
    assert table["concentration_nm"].isna().tolist() == [False, True]
    assert table["day"].tolist() == [3, 4]
    assert table["day"].dtype == np.int64


def test_a_note_of_several_tables_is_said_once(tmp_path: Path, capsys) -> None:
    paths = []
    for number in range(5):
        path = tmp_path / f"{number}.csv"
        mass = np.random.default_rng(number).normal(100.0, 9.0, 60)
        mass[:number] = np.nan
        pd.DataFrame({"frame": 1, "mass_kda": mass}).to_csv(path, index=False)
        paths.append(str(path))
    assert main(["species", *paths, "--k", "1"]) == 0
    error = capsys.readouterr().err
    (line,) = [line for line in error.splitlines() if "has an error of its own" in line]
    assert f"{paths[2]} and 2 more: no event" in line
    (line,) = [line for line in error.splitlines() if "without a mass" in line]
    assert f"{paths[1]} (1 event), {paths[2]} (2 events), {paths[3]} (3 events) and 1 more:" in line
