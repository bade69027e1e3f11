"""The sample configurations, run as a lab would run them: simulate, fit, compare with the truth."""

from __future__ import annotations

import io
import json
import tomllib
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pandas as pd
import pytest

from iscat_analysis.config import load_config
from iscat_analysis.records import EVENT_COLUMNS, FREE_PARAMETERS, REPEAT_COLUMNS
from iscat_analysis.schemas import schema
from iscat_cli import main, main_fit

MODES = ["mass", "localize", "joint"]

# Standard errors: of 8 events times 4 parameters, one beyond 5σ has a probability below 2e-5.
FAR = 5.0
BOUND_REACHED = 0.05


@pytest.fixture(scope="module")
def movies(tmp_path_factory, sample_configs) -> dict[str, Path]:
    """Simulate each sample once."""
    folder = tmp_path_factory.mktemp("samples")
    paths = {mode: folder / f"{mode}.tif" for mode in MODES}
    for mode, path in paths.items():
        arguments = ["simulate", "--config", str(sample_configs[mode]), "--out", str(path)]
        assert main([*arguments, "--quiet"]) == 0
    return paths


@pytest.fixture(scope="module")
def fitted(movies, sample_configs) -> dict[str, Path]:
    """Fit each sample once; what is printed lies in the folder as well."""
    folders = {}
    for mode, movie in movies.items():
        arguments = [str(movie), "--config", str(sample_configs[mode]), "--no-posterior"]
        with redirect_stdout(io.StringIO()) as printed:
            assert main_fit([*arguments, "--json", "--quiet"]) == 0
        folders[mode] = movie.with_suffix(".iscat")
        (folders[mode] / "printed.json").write_text(printed.getvalue(), encoding="utf-8")
    return folders


def _read(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"), parse_constant=pytest.fail)
    return found


def _check(value: Any, name: str) -> None:
    jsonschema.Draft202012Validator(schema(name)).validate(value)


@pytest.mark.parametrize("mode", MODES)
def test_the_truth_lies_beside_the_movie(mode: str, movies, sample_configs) -> None:
    truth = pd.read_csv(movies[mode].with_suffix(".truth.csv"))
    config = load_config(sample_configs[mode])
    events = config.simulation.events
    assert config.simulation.shape == (128, 128)
    assert truth["mass_kda"].nunique() == (1 if mode == "localize" else 8)
    assert truth["x_px"].tolist() == pytest.approx([event.x_px for event in events])


def test_the_same_seed_writes_the_same_bytes(movies, sample_configs, tmp_path) -> None:
    again = tmp_path / "mass.tif"
    main(["simulate", "--config", str(sample_configs["mass"]), "--out", str(again), "--seed", "1"])
    assert again.read_bytes() == movies["mass"].read_bytes()


def test_a_movie_is_not_overwritten_unasked(movies, sample_configs, capsys) -> None:
    before = movies["mass"].stat().st_mtime_ns
    arguments = ["simulate", "--config", str(sample_configs["mass"]), "--out", str(movies["mass"])]
    assert main(arguments) in (1, 2)
    (line,) = capsys.readouterr().err.splitlines()
    assert "overwrite" in line
    assert movies["mass"].stat().st_mtime_ns == before


@pytest.mark.parametrize("mode", MODES)
def test_bounds_of_the_samples(mode: str, sample_configs, capsys) -> None:
    assert main(["bounds", "--config", str(sample_configs[mode]), "--json"]) == 0
    report = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    for name in FREE_PARAMETERS[mode]:
        actual = {kind: bound[name] for kind, bound in report["actual"].items() if name in bound}
        assert 0 < actual["qcrb"] < actual["crb_single"] <= actual["crb_joint"] * (1 + 1e-12)


@pytest.mark.parametrize("mode", MODES)
def test_fits_meet_the_truth(mode: str, fitted, movies) -> None:
    fits = pd.read_csv(fitted[mode] / "fits.csv")
    truth = pd.read_csv(movies[mode].with_suffix(".truth.csv"))
    # of particles this heavy it is told what a line of light standards makes of them
    common = ["systematic_mass_kda"] if mode in ("mass", "joint") else []
    # eight particles do not exclude all errors of the optics, which move places at a known height
    common = ["systematic_x_nm", "systematic_y_nm", *common] if mode == "mass" else common
    large = ["model"] if mode == "mass" else []
    assert list(fits.columns) == [*EVENT_COLUMNS, *common, *REPEAT_COLUMNS, *large]
    assert len(fits) == len(truth) == 8
    assert set(fits["status"]) == {"ok"}
    distance = np.hypot(
        fits["x_px"].to_numpy()[:, None] - truth["x_px"].to_numpy(),
        fits["y_px"].to_numpy()[:, None] - truth["y_px"].to_numpy(),
    )
    partner = truth.iloc[distance.argmin(axis=1)].reset_index()
    for name in FREE_PARAMETERS[mode]:
        pulls = (fits[name] - partner[name]) / fits[f"sigma_{name}"]
        assert pulls.abs().max() < FAR, name
        assert (fits[f"sigma_{name}"] / fits[f"crb_{name}"] - 1).abs().max() < BOUND_REACHED, name
        assert (fits[f"qcrb_{name}"] < fits[f"crb_{name}"]).all()


@pytest.mark.parametrize("mode", MODES)
def test_the_folder_is_complete_and_follows_the_schemas(mode: str, fitted) -> None:
    names = {path.name for path in fitted[mode].iterdir()}
    expected = {"fits.csv", "fits.parquet", "summary.json", "config.toml", "report.html"}
    assert expected <= names
    assert "posterior.nc" not in names
    _check(_read(fitted[mode] / "summary.json"), "summary")
    printed = _read(fitted[mode] / "printed.json")
    _check(printed, "fit")
    _check(printed | {"events": [], "status": {}}, "fit")


def test_the_schema_refuses_what_is_wrong(fitted) -> None:
    """Control: one that accepts everything would pass all of these tests."""
    for change in (
        lambda fit: fit.pop("versions"),
        lambda fit: fit["events"][0].pop("crb_x_nm"),
        lambda fit: fit["events"][0].update(status="good"),
        lambda fit: fit["events"][0].update(p_value=1.5),
        lambda fit: fit["events"][0].update(sigma_x_nm=-1.0),
        lambda fit: fit["events"][0].update(unknown=1),
        lambda fit: fit.update(events=1),
        lambda fit: fit["input"].update(sha256="abc"),
    ):
        bad = _read(fitted["mass"] / "printed.json")
        change(bad)
        with pytest.raises(jsonschema.ValidationError):
            _check(bad, "fit")


@pytest.mark.large
def test_the_written_configuration_reruns_the_job(fitted, movies, tmp_path, capsys) -> None:
    written = fitted["mass"] / "config.toml"
    assert tomllib.loads(written.read_text())["fit"]["mode"] == "mass"
    again = tmp_path / "again.iscat"
    arguments = [str(movies["mass"]), "--config", str(written), "--out", str(again), "--json"]
    assert main_fit([*arguments, "--quiet", "--strict"]) == 0
    result = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert result["out"] == str(again)
    first, second = (pd.read_csv(folder / "fits.csv") for folder in (fitted["mass"], again))
    pd.testing.assert_frame_equal(first, second)
    assert [event["x_nm"] for event in result["events"]] == pytest.approx(list(second["x_nm"]))
