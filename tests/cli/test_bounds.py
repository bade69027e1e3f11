"""`iscat bounds` as a user meets it."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import numpy as np
import pandas as pd
import pytest

from iscat_analysis.bounds import paper
from iscat_analysis.report.bounds import PAPER_FILES
from iscat_analysis.report.vega import figures_in
from iscat_analysis.schemas import schema
from iscat_cli import main

SETUP = {"camera.pixel_size_nm": "84.4", "bounds.pixels": "25"}


def words(setup: dict[str, str] = SETUP) -> list[str]:
    return [word for item in setup.items() for word in ("--set", "=".join(item))]


def run(
    capsys: pytest.CaptureFixture[str], *arguments: str, setup: dict[str, str] = SETUP
) -> tuple[int, str, str]:
    status = main(["bounds", *words(setup), *arguments])
    said = capsys.readouterr()
    if "--json" in arguments:
        report = json.loads(said.out, parse_constant=pytest.fail)
        jsonschema.Draft202012Validator(schema("bounds")).validate(report)
    return status, said.out, said.err


def test_point(capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = run(capsys, "--mode", "joint")
    assert status == 0
    assert "CRB joint" in out
    assert "information used" in out
    assert err == ""


def test_json_is_one_object_with_scan(capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = run(capsys, "--json", "--quiet", "--scan", "z=0:100:50")
    report = json.loads(out)
    assert status == 0
    assert report["scan"]["columns"]["z"] == [0, 50, 100]
    assert report["per_photon"]["crb_joint"]["z_nm"] is None  # not free in mode mass


def test_scan_writes_table_and_figure(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "focus"
    status, _, _ = run(capsys, "--mode", "joint", "--scan", "focus=-400:400:200", "--out", str(out))
    assert status == 0
    names = {"bounds.json", "bounds.html", "scan.csv"}
    assert {p.name for p in out.iterdir()} == {*names, ".iscat-files"}
    drawn = figures_in(out / "bounds.html")
    assert "both at once, at best (Holevo)" in drawn["tradeoff"].data["rows"]["series"]
    table = pd.read_csv(out / "scan.csv")
    assert list(table["focus"]) == [-400, -200, 0, 200, 400]
    assert "configured: −300" in drawn["scan"].data["rows"]["series"]
    status, _, err = run(capsys, "--scan", "focus=0:1:1", "--out", str(out))
    assert status == 1
    assert "--overwrite" in err


def test_optimize_and_target(capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = run(capsys, "--mode", "joint", "--optimize", "focus", "--for", "mass")
    assert status == 0
    assert "best" in out
    assert "configured" in out
    status, out, _ = run(capsys, "--mode", "joint", "--target", "mass=5kDa")
    assert status == 0
    for word in ("frames after", "never enough", "shot noise", "finite background", "read noise"):
        assert word in out
    assert "samples_per_pixel" not in out
    points = ("--set", "camera.samples_per_pixel=1")
    status, out, _ = run(capsys, "--mode", "joint", "--target", "mass=5kDa", *points)
    assert status == 0
    assert "samples_per_pixel" in out


def test_pupil(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "pupil"
    search = ("--optimize", "pupil", "--for", "z,mass", "--free", "phase", "--mode", "joint")
    status, said, _ = run(capsys, *search, "--out", str(out))
    assert status == 0
    for word in ("reference_phase_deg", "Holevo", "of what one measurement can take", "descents"):
        assert word in said
    names = {"bounds.json", "bounds.html", "optics.toml"}
    assert {p.name for p in out.iterdir()} == {*names, ".iscat-files"}
    found = json.loads((out / "bounds.json").read_text(encoding="utf-8"))["pupil"]
    assert main(["bounds", "--config", str(out / "optics.toml"), "--json", "--quiet"]) == 0
    again = json.loads(capsys.readouterr().out)["actual"]["crb_joint"]
    for name in ("z_nm", "mass_kda"):
        assert again[name] == pytest.approx(found["sigma"][name]["best"], rel=1e-9)
    status, said, _ = run(capsys, *search, "--json", "--quiet", "--seed", "0")
    assert json.loads(said)["pupil"] == found  # same seed, same pupil


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--set", "bounds.photons_per_pixel=0"], "photons_per_pixel: input should be greater"),
        (["--set", "optics.na=1.6"], "lower na"),
        (["--set", "optics.n_sample=0"], "optics.n_sample"),
        (["--set", "optics.attenuation=-0.1"], "optics.attenuation"),
        (["--set", "bounds.z_nm=-1"], "bounds.z_nm"),
        (["--set", "particle.height_nm=-1"], "particle.height_nm"),
        (["--set", "bounds.pixels=0"], "--set bounds.pixels is given twice"),
        (["--scan", "z=0-100"], "start:stop:step"),
        (["--scan", "depth=0:1:1"], "NAME one of z, focus"),
        (["--optimize", "focus"], "go together"),
        (["--optimize", "focus", "--for", "x,y"], "choose one of x, y, z, mass"),
        (["--optimize", "pupil", "--for", "colour"], "choose one of x, y, z, mass"),
        (["--optimize", "pupil", "--for", "z"], "z is not free in mode mass"),
        (["--optimize", "pupil", "--free", "colour"], "--free colour: choose among focus"),
        (["--optimize", "pupil", "--set", "optics.scheme=darkfield"], "has no reference"),
        (["--optimize", "focus", "--for", "mass", "--free", "phase"], "--free also goes with"),
        (["--optimize", "focus", "--for", "mass", "--seed", "1"], "--seed needs --optimize pupil"),
        (["--for", "mass"], "go together"),
        (["--scan", "z=0:1:1", "--target", "mass=5"], "choose one of"),
        (["--preset", "dong2021"], "needs --out DIR"),
        (["--preset", "dong2021", "--out", "x"], "leave --config, --set and --mode away"),
        (["--target", "mass=none"], "mass=5kDa"),
    ],
)
def test_bad_input_gets_one_line(only_line, arguments: list[str], message: str) -> None:
    assert message in only_line("bounds", *words(), *arguments)


def test_unidentifiable_directions_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    few = {"bounds.pixels": "2", "camera.pixel_size_nm": "150"}
    status, out, _ = run(capsys, "--mode", "joint", setup=few)
    assert status == 0
    assert "unidentifiable: z_nm–mass_kda" in out


def test_the_paper_whole(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(paper, "HEIGHTS_NM", np.array([0.0, 500.0, 1000.0]))
    monkeypatch.setattr(paper, "FOCI_NM", np.array([-1000.0, 0.0, 1000.0]))
    out = tmp_path / "paper"
    status = main(["bounds", "--preset", "dong2021", "--out", str(out)])
    said = capsys.readouterr()
    assert status == 0
    assert "114" in said.out
    assert {p.name for p in out.iterdir()} == {*PAPER_FILES, ".iscat-files"}
    table = pd.read_csv(out / "comparison.csv").set_index("quantity")
    assert table.loc["z_cobri", "printed"] == 114
    assert table.loc["z_cobri", "exact"] == pytest.approx(92.0265, abs=1e-3)
    curves = pd.read_csv(out / "fig_2e.csv")
    assert set(curves["scheme"]) == {"iscat", "cobri", "darkfield"}
    assert set(curves["convention"]) == {"dong2021", "exact"}
    page = (out / "comparison.html").read_text(encoding="utf-8")
    for text in ("113.7", "114.1", "92.03", "Figure 4d", "data:image/png;base64"):
        assert text in page
