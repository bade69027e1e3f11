"""A mass line meets tables of events: contrasts become masses, whatever masses the table has."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tifffile

import iscat_analysis as ia
from iscat_analysis.calibration import (
    calibrate_mass,
    contrast_over,
    standards_of,
    with_line,
    with_standards,
)
from iscat_analysis.species.tables import event_table, sentences
from iscat_cli import main

SLOPE, OFFSET = -3e-5, -1e-5
LINE = f"""[calibration]
gradient_per_kda = {SLOPE}
offset = {OFFSET}
gradient_se_per_kda = 3e-7
offset_se = 0.0
"""


def contrasts(mass: np.ndarray) -> np.ndarray:
    return SLOPE * mass + np.sign(mass) * OFFSET


@pytest.fixture
def line(tmp_path: Path) -> Path:
    (tmp_path / "line").mkdir()
    (tmp_path / "line" / "calibration.toml").write_text(LINE)
    return tmp_path / "line" / "calibration.toml"


@pytest.fixture
def mass() -> np.ndarray:
    random = np.random.default_rng(1)
    kinds = np.repeat([66.0, 132.0], 60)
    return random.choice([-1.0, 1.0], 120) * random.normal(kinds, 5.0)


def test_contrasts_alone_and_masses_that_are_missing(
    mass: np.ndarray, line: Path, tmp_path: Path
) -> None:
    path = tmp_path / "events.csv"
    alone = pd.DataFrame({"contrasts": contrasts(mass)})
    for table in (alone, alone.assign(masses_kDa=np.nan)):
        table.to_csv(path, index=False)
        for given in (line, line.parent, str(line)):
            found = event_table(path, calibration=given)
            np.testing.assert_allclose(found.mass_kda, mass, rtol=1e-9)
            assert not any("calibration" in note for note in sentences(found.findings))
        with pytest.raises(ia.DataError, match=r"has contrasts and no masses; give `calibration`"):
            event_table(path)
    some = alone.assign(masses_kDa=np.where(mass > 0, mass, np.nan))
    (note,) = [n for n in sentences(event_table(some).findings) if "left out" in n]
    assert "`calibration` gives them the mass of their contrast" in note


def test_masses_of_the_table_are_replaced_and_that_is_said(mass: np.ndarray, line: Path) -> None:
    table = pd.DataFrame({"contrast": contrasts(mass), "mass_kda": 2 * mass})
    found = event_table(table, calibration=line)
    np.testing.assert_allclose(found.mass_kda, mass, rtol=1e-9)
    assert "table: masses are those of `calibration`, 0.5 times the table's own (median)" in (
        sentences(found.findings)
    )
    with pytest.raises(ia.DataError, match="table: has masses and no contrasts"):
        event_table(table[["mass_kda"]], calibration=line)


def test_errors_of_events_and_of_the_line(mass: np.ndarray, line: Path) -> None:
    """σ is that of the contrast; what the line leaves open is common to all events."""
    own = 2 * mass
    table = pd.DataFrame(
        {"contrast": SLOPE * mass, "mass_kda": own, "sigma_mass_kda": 8.0, "status": "ok",
         "systematic_mass_kda": 99.0}
    )  # fmt: skip
    found = event_table(table, calibration=line)
    sigma_contrast = 8.0 * np.abs(SLOPE * mass / own)
    np.testing.assert_allclose(found.sigma_kda, sigma_contrast / abs(SLOPE))
    assert found.scale_error is not None
    assert found.scale_error(np.array([100.0]))[0] == pytest.approx(1.0, rel=0.01)  # 1 % of 100
    unknown = LINE.replace("3e-7", "0.0")
    line.write_text(unknown)
    assert event_table(table, calibration=line).scale_error is None


def test_a_status_of_other_optics_no_longer_counts(mass: np.ndarray, line: Path) -> None:
    status = np.where(mass > 0, "ok", "uncalibrated_optics")
    status[0] = "poor_fit"
    table = pd.DataFrame(
        {"contrast": contrasts(mass), "mass_kda": mass, "sigma_mass_kda": 5.0, "status": status}
    )
    assert event_table(table).mass_kda.size == np.count_nonzero(status == "ok")
    assert event_table(table, calibration=line).mass_kda.size == mass.size - 1


def test_a_line_of_other_optics_is_converted(mass: np.ndarray, tmp_path: Path) -> None:
    """Of a table of ours the optics are known: focus changes contrast per kDa."""
    folder = tmp_path / "m.iscat"
    folder.mkdir()
    optics = {"optics.na": 1.3, "optics.focus_nm": 0.0, "camera.pixel_size_nm": 80.0}
    table = pd.DataFrame({"contrast": contrasts(mass), "mass_kda": mass, "sigma_mass_kda": 5.0})
    table.assign(status="ok").to_csv(folder / "fits.csv", index=False)
    recorded = ia.configure(optics, settings={"calibration.gradient_per_kda": SLOPE})

    line = with_standards(recorded).calibration
    same = ia.configure(optics)
    other = ia.configure(optics, settings={"optics.focus_nm": 5.0})
    masses = {}
    for name, config in (("same", same), ("other", other)):
        (folder / "config.toml").write_text(ia.config_to_toml(config))
        masses[name] = event_table(folder, calibration=line).mass_kda
    ratio, refusal = contrast_over(other, standards_of(recorded))
    assert not refusal
    assert abs(ratio - 1) > 0.02
    np.testing.assert_allclose(masses["same"] / masses["other"], ratio, rtol=1e-6)


def test_a_measured_line_is_a_line(mass: np.ndarray) -> None:
    found = calibrate_mass(contrasts(np.abs(mass)), [66.0, 132.0])
    weighed = event_table(pd.DataFrame({"contrast": contrasts(mass)}), calibration=found)
    np.testing.assert_allclose(weighed.mass_kda, found.mass_kda(contrasts(mass)), rtol=1e-4)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("[optics]\nna = 1.4\n", r"has no section \[calibration\]"),
        ("[calibration]\noffset = 0.0\n", "gradient_per_kda"),
        (3.0, "`calibration`: is float; give the path of a mass line"),
    ],
)
def test_what_is_no_line_is_refused(given: object, said: str, tmp_path: Path) -> None:
    if isinstance(given, str):
        (tmp_path / "line.toml").write_text(given)
        given = tmp_path / "line.toml"
    with pytest.raises(ia.ConfigError, match=said):
        event_table(pd.DataFrame({"contrast": [-0.01]}), calibration=given)  # type: ignore[arg-type]


def test_every_question_takes_it(mass: np.ndarray, line: Path, tmp_path: Path) -> None:
    alone = pd.DataFrame({"contrast": contrasts(mass), "frame": np.arange(mass.size)})
    known = {"calibration": line, "sigma_kda": 5.0, "above_kda": 30.0}
    assert ia.find_species(alone, k=2, draws=0, **known).species["mass_kda"][0] == pytest.approx(
        66.0, abs=2
    )
    assert ia.compare_samples(alone, alone, k=2, **known).same.p_value > 0.9
    assert len(ia.compare_tables([alone, alone], k=2, **known)) == 1
    assert ia.fit_kinetics(alone, frame_rate_hz=10.0, calibration=line).landing.per_second > 3
    samples = pd.DataFrame({"concentration_nm": [3.0, 30.0]})
    binding = ia.fit_kd(samples, tables=[alone, alone], model="dimer", masses_kda=[66.0], **known)
    assert binding.fit.masses_kda[0] == pytest.approx(66.0, abs=3)
    path = tmp_path / "e.csv"
    alone.to_csv(path, index=False)
    assert main(["species", str(path), "--k", "2", "--draws", "0"]) == 1
    given = ["--calibration", str(line)]
    assert main(["species", str(path), "--k", "2", "--draws", "0", *given]) == 0


def test_a_configuration_takes_it_whole(line: Path) -> None:
    first = {"calibration.gradient_per_kda": -5e-5, "calibration.correlation": 0.5}
    config = ia.configure(with_line(first, line), settings=["optics.na=1.3"])
    assert config.calibration is not None
    assert config.calibration.gradient_per_kda == SLOPE
    assert config.calibration.correlation == 0.0
    assert config.optics.na == 1.3
    assert with_line(first, None) is first


def test_commands_for_movies_take_it(
    line: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    taken = []

    def fit_stack(_: Path, config: ia.Config, **__: object) -> None:
        taken.append(config)
        raise ia.DataError("enough")

    monkeypatch.setattr("iscat_analysis.pipeline.fit_stack", fit_stack)
    monkeypatch.setattr("iscat_analysis.day.jobs.fit_stack", fit_stack)
    tifffile.imwrite(tmp_path / "m.tif", np.ones((5, 8, 8), np.uint16))
    (tmp_path / "iscat.toml").write_text("[calibration]\ngradient_per_kda = -9e-5\n")
    assert main(["fit", str(tmp_path / "m.tif"), "--calibration", str(line)]) == 1
    (tmp_path / "samples.csv").write_text("path\nm.tif\n")
    batch = ["batch", str(tmp_path / "samples.csv"), "--out", str(tmp_path / "day")]
    assert main([*batch, "--calibration", str(line)]) == 3
    assert [config.calibration.gradient_per_kda for config in taken] == [SLOPE, SLOPE]
    (tmp_path / "samples.csv").write_text("path,role,standards\nm.tif,calibrant,66\n")
    capsys.readouterr()
    assert main([*batch, "--calibration", str(line)]) == 2
    assert "--calibration is a mass line, and the standards" in capsys.readouterr().err
