"""`iscat benchmark` as a user runs it."""

from __future__ import annotations

import json
import math
from pathlib import Path

import jsonschema
import pytest

from iscat_analysis.report.vega import figures_in
from iscat_analysis.schemas import schema
from iscat_cli import main
from iscat_cli.study import benchmark_table

SMALL = ["--set", "fit.roi_nm=900", "--set", "fit.z_range_nm=[0,300]", "--no-posterior"]


@pytest.mark.parametrize("scheme", ["iscat", pytest.param("darkfield", marks=pytest.mark.large)])
def test_benchmark(
    scheme: str, sample_configs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "c.toml"
    text = sample_configs["joint"].read_text(encoding="utf-8")
    if scheme == "darkfield":
        head, _, rest = text.partition("[calibration]")
        text = head + "[bounds]" + rest.partition("[bounds]")[2]
        text = text.replace('"iscat"', '"darkfield"').replace(
            "photons_per_pixel = 1e4", "photons_per_pixel = 50"
        )
    config.write_text(text, encoding="utf-8")
    out = tmp_path / "out"
    arguments = ["benchmark", "--config", str(config), "--out", str(out), "--trials", "20", *SMALL]
    as_json = ["--json"] if scheme == "iscat" else []
    assert main([*arguments, *as_json]) == 0
    printed = capsys.readouterr().out
    written = json.loads((out / "benchmark.json").read_text(encoding="utf-8"))
    if as_json:
        assert json.loads(printed) == written
    else:
        assert "spread/CRB" in printed
    jsonschema.Draft202012Validator(schema("benchmark")).validate(written)
    assert written["scheme"] == scheme
    page = (out / "benchmark.html").read_text(encoding="utf-8")
    assert len(figures_in(out / "benchmark.html")) >= 9
    assert page.rstrip().endswith("</html>")
    assert main(arguments) == 1
    assert "--overwrite" in capsys.readouterr().err


@pytest.mark.large
def test_benchmark_of_spheres(
    sample_configs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The diameter is scored; estimators of others do not know it."""
    config, out = str(sample_configs["size"]), tmp_path / "out"
    arguments = ["benchmark", "--config", config, "--out", str(out), "--trials", "20", *SMALL]
    assert main([*arguments, "--estimator", "iscat"]) == 2
    assert "of dipoles" in capsys.readouterr().err
    assert main([*arguments, "--set", "bounds.photons_per_pixel=1e4"]) == 0
    assert "diameter_nm" in capsys.readouterr().out
    written = json.loads((out / "benchmark.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator(schema("benchmark")).validate(written)
    assert not {"mass", "joint"} & set(written)
    assert 0.5 < written["size"]["diameter_nm"]["spread_over_crb"] < 1.7
    assert "diameter [nm]" in (out / "benchmark.html").read_text(encoding="utf-8")


def test_benchmark_refuses_too_few_trials(
    sample_configs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--config", str(sample_configs["mass"]), "--out", str(tmp_path / "out")]
    assert main(["benchmark", *arguments, "--trials", "3"]) == 2
    assert "--trials" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_fits_of_ambiguous_height_that_are_left_out_are_told(
    sample_configs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dim = ["--set", "bounds.photons_per_pixel=20", "--set", "fit.roi_nm=900", "--no-posterior"]
    arguments = ["--config", str(sample_configs["mass"]), "--out", str(tmp_path / "out"), *dim]
    assert main(["benchmark", *arguments, "--trials", "20"]) == 0
    said = capsys.readouterr().err
    assert "mode joint: 20 of 20 fits have the status ambiguous_z and are left out" in said
    assert "mode mass" not in said


def test_a_mode_without_usable_fits_has_one_dash_in_each_cell() -> None:
    none = math.nan, math.nan
    score = dict.fromkeys(("bias", "spread", "spread_over_crb", "coverage68"), math.nan)
    entry = {"failed": 20, "trials": 20,
             "x_nm": {**score, "crb": 1.0, "qcrb": 0.5, "spread_over_crb_ci95": none}}  # fmt: skip
    table = benchmark_table(dict.fromkeys(("mass", "localize", "joint"), entry))
    assert list(table.columns[7].cells) == ["–"] * 3
