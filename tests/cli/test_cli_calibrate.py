"""`iscat calibrate`: from files to a folder, what is printed, and one clear line for bad input."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pandas as pd
import pytest
import tifffile

from iscat_analysis.config import load_config
from iscat_analysis.records import EVENT_COLUMNS
from iscat_analysis.schemas import schema
from iscat_cli import main

Captured = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("camera")
    rng = np.random.default_rng(1)
    light = np.linspace(5e3, 2e4, 48 * 48).reshape(48, 48)
    for name, level in (("movie", 1.0), ("dark", 0.0)):
        electrons = rng.poisson(level * light, (120, 48, 48)) + 8 * rng.standard_normal(
            (120, 48, 48)
        )
        counts = np.rint(electrons / 2 + 200).astype(np.uint16)
        if level:
            counts[60, 4, 5] = 65535
        tifffile.imwrite(folder / f"{name}.tif", counts)
    return folder


def fits_table(folder: Path, *, sign: float = -1.0) -> Path:
    """Write a fits.csv of three standards, of which a fifth leave, in the package's own columns."""
    rng = np.random.default_rng(2)
    true = np.repeat([66.0, 146.0, 480.0], 80)
    mass = rng.normal(true, 8.0) * np.where(np.arange(240) % 5 == 0, -1, 1)
    table = pd.DataFrame({name: np.zeros(240) for name in EVENT_COLUMNS})
    table["mass_kda"] = mass * 1.3  # the absolute model is off
    table["sigma_mass_kda"] = 8.0 * 1.3
    table["contrast"] = sign * 3.1e-5 * mass
    table["status"] = "ok"
    table["flags"] = ""
    bad = table.iloc[:5].assign(status="poor_fit", contrast=-0.5)
    path = folder / "fits.csv"
    pd.concat([table, bad]).to_csv(path, index=False)
    return path


def checked(name: str, printed: str, folder: Path) -> dict[str, Any]:
    """Read what was printed; it and the file in the folder follow the schema, and fill it."""
    found = json.loads(printed, parse_constant=pytest.fail)
    written = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
    for document in (found, written):
        jsonschema.Draft202012Validator(schema(name)).validate(document)
    assert set(found) | set(written) == set(schema(name)["properties"])
    return dict(found)


def test_camera_from_a_movie_and_a_dark(recordings: Path, tmp_path: Path, capsys: Captured) -> None:
    out = tmp_path / "camera"
    movie, dark = str(recordings / "movie.tif"), str(recordings / "dark.tif")
    status = main(
        ["calibrate", "camera", movie, "--dark", dark, "--maps", "--out", str(out), "--json"]
    )
    said = capsys.readouterr()
    assert status == 0, said.err
    found = checked("camera", said.out, out)
    assert found["out"] == str(out)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(found | {"gain_e_per_adu": {"value": 1.0}}, schema("camera"))
    for key, truth in (
        ("gain_e_per_adu", 2.0),
        ("offset_adu", 200.0),
        ("read_noise_e", np.hypot(8, 2 / np.sqrt(12))),
    ):
        assert abs(found[key]["value"] - truth) < 4 * found[key]["se"]
    assert found["masked_pixels"] == {"saturated": 1, "clipped": 0, "dead": 0, "hot": 0}
    assert "saturated and left out" in said.err
    assert found["shot_limited_frames"] == 32
    assert sorted(path.name for path in out.iterdir()) == [
        ".iscat-files", "camera.html", "camera.json", "camera.toml", "gain_e_per_adu.tif",
        "masked.tif", "offset_adu.tif", "read_noise_e.tif",
    ]  # fmt: skip
    assert tifffile.imread(out / "masked.tif").sum() == 1
    camera = load_config(out / "camera.toml").camera  # a section to paste, with paths beside it
    assert Path(str(camera.gain_e_per_adu)) == out / "gain_e_per_adu.tif"
    page = (out / "camera.html").read_text(encoding="utf-8")
    assert "Photon transfer" in page
    assert "Noise against averaging" in page


def test_camera_prints_a_table_and_a_verdict(
    recordings: Path, tmp_path: Path, capsys: Captured
) -> None:
    movie = str(recordings / "movie.tif")
    arguments = ["calibrate", "camera", movie, "--offset", "200", "--out", str(tmp_path / "c")]
    assert main(arguments) == 0
    said = capsys.readouterr()
    contents = json.loads((tmp_path / "c" / "camera.json").read_text(encoding="utf-8"))
    jsonschema.validate(contents, schema("camera"))
    assert re.search(r"gain \[e/count\] +(1\.9|2\.0)", said.out)
    assert re.search(r"offset \[counts\] +200 +given +given", said.out)
    assert "shot-noise limited up to" in said.out
    assert main(arguments) == 1  # never over an earlier result
    assert "--overwrite" in capsys.readouterr().err
    assert main([*arguments, "--overwrite", "--quiet"]) == 0
    assert capsys.readouterr().err == ""


def test_camera_mistakes_are_one_line_each(recordings: Path, tmp_path: Path, only_line) -> None:
    dark, out = str(recordings / "dark.tif"), tmp_path / "x"
    for arguments, status, message in (
        ([], 2, "give a flat, the movie, or --dark"),
        (["--dark", dark, "--offset", "3"], 2, "leave --offset out"),
        ([str(tmp_path / "none.tif")], 1, "no such file"),
        ([dark, "--dark", dark], 1, "no darker than"),
    ):
        given = ["calibrate", "camera", *arguments, "--out", str(out), "--quiet"]
        assert message in only_line(*given, status=status)
        assert not out.exists()


def test_mass_from_the_packages_own_table(tmp_path: Path, capsys: Captured) -> None:
    path = fits_table(tmp_path)
    arguments = ["calibrate", "mass", str(path), "--standards", "480,66,146"]
    assert main([*arguments, "--json"]) == 0
    out = tmp_path / "fits.calibration"
    found = checked("calibration", capsys.readouterr().out, out)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(found | {"landing": "grey"}, schema("calibration"))
    assert abs(found["gradient_per_kda"] + 3.1e-5) < 4 * found["gradient_se"]
    assert found["landing"] == "dark"
    assert found["events"] == 192
    assert sorted(p.name for p in out.iterdir()) == [
        ".iscat-files", "calibration.html", "calibration.json", "calibration.toml",
    ]  # fmt: skip
    assert load_config(out / "calibration.toml").calibration is not None
    assert json.loads((out / "calibration.json").read_text())["dof"] == 1
    page = (out / "calibration.html").read_text(encoding="utf-8")
    assert "line through the standards" in page
    of_a_folder = [*arguments[:2], str(tmp_path), *arguments[3:], "--out", str(tmp_path / "same")]
    assert main([*of_a_folder, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["gradient_per_kda"] == found["gradient_per_kda"]


def test_a_bright_table_says_so_itself(tmp_path: Path, capsys: Captured) -> None:
    path = fits_table(tmp_path, sign=1.0)
    arguments = ["calibrate", "mass", str(path), "--standards", "66:0.2,146:0.5,480"]
    assert main(arguments) == 0
    toml = tomllib.loads((tmp_path / "fits.calibration" / "calibration.toml").read_text())
    assert toml["calibration"]["gradient_per_kda"] > 0
    assert "gradient_per_kda = 3" in capsys.readouterr().out
    assert main([*arguments, "--landing", "dark", "--out", str(tmp_path / "y"), "--quiet"]) == 1
    assert "the contrast has the wrong sign" in capsys.readouterr().err


def test_mass_mistakes_are_one_line_each(tmp_path: Path, only_line) -> None:
    path, out = str(fits_table(tmp_path)), tmp_path / "x"
    empty = tmp_path / "empty.csv"
    empty.write_text(",".join(EVENT_COLUMNS) + "\n")
    for events, standards, status, message in (
        (path, "66,146,300", 1, "do not match the peaks"),
        (path, "66", 2, "two or more positive masses"),
        (path, "66,heavy", 2, "'heavy' is not a mass in kDa"),
        (str(empty), "66,146", 1, "holds no event with status ok"),
        (str(tmp_path / "none.csv"), "66,146", 1, "cannot be read"),
    ):
        given = ["calibrate", "mass", events, "--standards", standards, "--quiet"]
        assert message in only_line(*given, "--out", str(out), status=status)
        assert not out.exists()


def test_refeyns_table_through_the_command(
    data_dir: Path, tmp_path: Path, capsys: Captured
) -> None:
    path = data_dir / "refeyn_events_2.4.2.h5"
    if not path.is_file():
        pytest.skip(f"no measured table: {path} is absent")
    given = ["calibrate", "mass", str(path), "--standards", "66,146,480", "--json"]
    assert main([*given, "--out", str(tmp_path / "r")]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["gradient_per_kda"] == pytest.approx(-6.1013e-5, rel=0.03)


def test_calibrate_alone_shows_its_commands(capsys: Captured) -> None:
    assert main(["calibrate"]) == 0
    shown = capsys.readouterr().out
    assert "camera" in shown
    assert "mass" in shown
