"""`iscat challenge`, and `iscat benchmark` of other people's estimators, as a user runs them."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import numpy as np
import pandas as pd
import pytest

from iscat_analysis.schemas import schema
from iscat_cli import main

SMALL = ["--set", "fit.roi_nm=900", "--set", "fit.z_range_nm=[0,300]", "--set", "bounds.pixels=11"]


@pytest.fixture
def made(sample_configs: dict[str, Path], tmp_path: Path) -> Path:
    folder = tmp_path / "made"
    arguments = ["--config", str(sample_configs["joint"]), "--out", str(folder), "--stacks", "26"]
    fewer = ["--set", "bounds.n_before=4", "--set", "bounds.n_after=4", "--set",
             "simulation.events=[]", *SMALL]  # fmt: skip
    assert main(["challenge", "make", *arguments, *fewer, "--blind", "--quiet"]) == 0
    return folder


def _results(folder: Path) -> pd.DataFrame:
    text = folder.with_name("made.truth.json").read_text(encoding="utf-8")
    table = pd.DataFrame(json.loads(text)["events"])
    noise = np.random.default_rng(1).normal(0, 5.0, len(table))
    return table[["file", "mass_kda"]].assign(x_nm=table["x_nm"] + noise)


def test_a_blind_challenge_from_making_to_the_page(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results, out = tmp_path / "r.csv", tmp_path / "scores"
    _results(made).to_csv(results, index=False)
    archive = ["--archive", str(tmp_path / "scores.zip")]
    scored = ["challenge", "score", str(made), str(results), "--estimator", "json:dumps"]
    assert main([*scored, "--out", str(out), *archive]) == 0
    shown = capsys.readouterr()
    assert "efficiency" in shown.out
    assert "0 of 26" in shown.out
    assert "stack, json:dumps: 26 of 26 failed: TypeError" in shown.err
    assert "stack, r, mass_kda: below the bound" in shown.err
    written = json.loads((out / "challenge.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator(schema("challenge")).validate(written)
    assert written["challenge"]["blind"]
    assert written["parts"]["stack"]["estimators"]["r"]["mass_kda"]["below_bound"]
    assert [(one["estimator"], one["below_bound"]) for one in written["ranking"]] == [
        ("json:dumps", False), ("r", True)
    ]  # fmt: skip
    page = (out / "challenge.html").read_text(encoding="utf-8")
    assert "not ranked" in page
    assert (tmp_path / "scores.zip").stat().st_size > 1000


def test_what_cannot_be_scored_is_said(made: Path, tmp_path: Path, only_line) -> None:
    score = ("challenge", "score", str(made))
    assert "nothing to score" in only_line(*score)
    assert "absent.csv" in only_line(*score, "absent.csv", status=1)
    made.with_name("made.truth.json").unlink()
    assert "give it as --truth" in only_line(*score, "absent.csv", status=1)
    line = only_line("challenge", "make", "--out", str(tmp_path / "x"))
    assert "--preset or --config" in line


def test_estimators_that_can_be_named_are_listed(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("iscat_contest.estimators.find_spec", lambda _: None)
    assert main(["benchmark", "--list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("gauss-mle ") and "not installed" not in line for line in lines)
    assert any("piscat" in line and "--no-deps piscat" in line for line in lines)


def test_one_own_simulation_is_scored(
    made: Path, sample_configs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results, truth = tmp_path / "r.csv", tmp_path / "t.csv"
    table = _results(made)
    table.assign(x_nm=table["x_nm"] + 1.0).to_csv(results, index=False)
    table.to_csv(truth, index=False)
    capsys.readouterr()
    given = ["benchmark", "--config", str(sample_configs["joint"]), "--truth", str(truth), *SMALL]
    assert main([*given, "--results", str(results), "--json", "--quiet"]) == 0
    found = json.loads(capsys.readouterr().out)
    jsonschema.Draft202012Validator(schema("challenge")).validate(found)
    assert found["parts"]["results"]["estimators"]["r"]["x_nm"]["bias"] == pytest.approx(1.0)
    assert main(given) == 2
    assert "give both" in capsys.readouterr().err
    table.assign(x_nm=table["x_nm"] / 84.4).to_csv(results, index=False)
    assert main([*given, "--results", str(results)]) == 1
    assert "in pixels" in capsys.readouterr().err


@pytest.mark.large
def test_estimators_are_compared_on_the_same_counts(
    sample_configs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    arguments = ["benchmark", "--config", str(sample_configs["mass"]), "--out", str(out)]
    others = ["--estimator", "iscat", "--estimator", "peak", "--estimator", "json:dumps"]
    assert main([*arguments, "--trials", "40", "--no-posterior", *SMALL, *others]) == 0
    assert "information kept" in capsys.readouterr().out
    written = json.loads((out / "benchmark.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator(schema("benchmark")).validate(written)
    ours, failed = (written["estimators"][name]["mass"] for name in ("iscat", "json:dumps"))
    low, high = ours["mass_kda"]["efficiency_crb_ci95"]
    assert low < 1.4
    assert high > 0.7
    assert failed["failed"] == 40
    assert sum(failed["failures"].values()) == 40
    assert written["ranking"][0]["estimator"] == "iscat"
    assert set(written["estimator_curves"]) >= {"photons", "mass", "height", "focus", "density"}
    page = (out / "benchmark.html").read_text(encoding="utf-8")
    assert "Where each is best" in page
    assert "Who is best where" in page
    found = written["estimator_map"]
    for name, table in found["parameters"].items():
        rows = [who for row in table["best"] for who in row]
        assert len(rows) == len(found["photons"]) * len(found["height_nm"])
        assert rows.count("iscat") > len(rows) / 2, name
