"""The scale of masses belongs to the optics of its standards; what nobody measured is budgeted."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from shared_errors import systematic

import iscat_analysis as ia
from iscat_analysis.answers.calibrations import mass_calibration
from iscat_analysis.calibration import as_given, contrast_over, standards_of, with_standards
from iscat_analysis.config import Config, config_to_toml, configure
from iscat_analysis.errors import ConfigError
from iscat_analysis.inference.counts import counts_likelihood
from iscat_analysis.inference.laws import CONDITIONAL
from iscat_analysis.optics.forward import PixelGrid, forward_model, signed_peak
from iscat_analysis.records import EVENT_COLUMNS, Box, Status
from iscat_analysis.trust.systematic import (
    budget_of,
    contributions,
    explained_kda,
    misfit_error,
    total,
    wide_species,
)

GRADIENT, MASS, LIGHT, FRAMES = -3.1e-5, 205.0, 3e6, 100
PIXEL_NM = 84.4
STANDARDS = ia.Optics(focus_nm=-300.0)
CAMERA, PROTEIN = ia.Camera(pixel_size_nm=PIXEL_NM), ia.Particle(mass_kda=MASS)
LINE = ia.Calibration(gradient_per_kda=GRADIENT, optics=STANDARDS, height_nm=5.0)


def _config(**settings: Any) -> Config:
    base = {
        "optics.focus_nm": -300.0,
        "camera.pixel_size_nm": PIXEL_NM,
        "particle.mass_kda": MASS,
        "background.method": "sliding",
        "calibration.gradient_per_kda": GRADIENT,
    }
    return configure(settings=base | settings)


def _recorded(**optics: Any) -> dict[str, Any]:
    return {
        "calibration.optics": {"focus_nm": -300.0, **optics},
        "calibration.height_nm": 5.0,
        "calibration.camera": {"pixel_size_nm": PIXEL_NM, "samples_per_pixel": "auto"},
    }


def _event(mass: float = MASS) -> pd.DataFrame:
    row = dict.fromkeys(EVENT_COLUMNS, 0.0)
    values = {"z_nm": 5.0, "mass_kda": mass, "n_before": FRAMES, "n_after": FRAMES,
              "sigma_mass_kda": 2.0, "status": "ok", "flags": ""}  # fmt: skip
    return pd.DataFrame([row | values])


def _fit(here: ia.Optics, line: ia.Calibration) -> pd.DataFrame:
    """Fit a picture of a particle that scatters as it does in the optics of the standards."""
    light = FRAMES * LIGHT * (1 + ia.psf(here, PROTEIN, CAMERA, calibration=LINE))
    counts = np.random.default_rng(5).poisson([np.full_like(light, FRAMES * LIGHT), light])
    return ia.fit_rois(
        counts[:1], counts[1:], here, PROTEIN, CAMERA, mode="mass", calibration=line,
        n_before=FRAMES, n_after=FRAMES,
    )  # fmt: skip


@pytest.mark.parametrize(("focus_nm", "expected"), [(-330.0, 0.8789), (-360.0, 0.7465)])
def test_a_mass_is_the_same_at_another_focus(focus_nm: float, expected: float) -> None:
    here = ia.Optics(focus_nm=focus_nm)
    scale = forward_model(_config(**{"optics.focus_nm": focus_nm, **_recorded()}), 1000.0).scale
    assert scale.carried == pytest.approx(expected, abs=1e-4)
    assert scale.refusal == ""
    row = _fit(here, LINE).iloc[0]
    assert abs(row["mass_kda"] - MASS) < 4 * row["sigma_mass_kda"] < 0.02 * MASS
    assert row["status"] == "ok"
    # control: the gradient taken as it is, at the optics of the movie
    blind = _fit(here, ia.Calibration(gradient_per_kda=GRADIENT)).iloc[0]
    assert blind["mass_kda"] == pytest.approx(expected * row["mass_kda"], rel=1e-3)
    assert blind["contrast"] == pytest.approx(row["contrast"], rel=1e-6)


def test_a_height_is_carried_like_a_focus() -> None:
    """At a height of 12 nm particles have another contrast than standards at 5 nm."""
    higher = configure(_config(**_recorded()), settings={"particle.height_nm": 12.0})
    ratio, refusal = contrast_over(higher, standards_of(_config()))
    scale = forward_model(higher, 1000.0).scale
    assert refusal == ""
    assert scale.carried == pytest.approx(ratio, rel=1e-12)
    peaks = [
        signed_peak(forward_model(each.model_copy(update={"calibration": None}), 2000.0))
        for each in (higher, _config())
    ]
    assert scale.carried == pytest.approx(peaks[0] / peaks[1], rel=1e-9)


@pytest.mark.parametrize(
    ("here", "why"),
    [
        ({"focus_nm": -420.0}, "more than a third"),
        ({"wavelength_nm": 532.0}, "at 525 nm, and this is at 532 nm"),
        ({"polarization": "circular", "analyzer": True}, "optics.polarization = linear"),
        ({"scheme": "cobri", "focus_nm": 300.0, "attenuation": 0.1,
          "reference_phase_deg": 180.0}, "optics.scheme = iscat"),
    ],
)  # fmt: skip
def test_what_the_model_does_not_carry_is_flagged(here: dict[str, Any], why: str) -> None:
    optics = ia.Optics(**{"focus_nm": -300.0, **here})
    config = _config(**_recorded(), **{f"optics.{key}": value for key, value in here.items()})
    try:
        scale = forward_model(config, 1000.0).scale
    except ConfigError:  # bright here, dark there: turn the reference
        optics = optics.model_copy(update={"reference_phase_deg": 0.0})
        config = configure(config, settings={"optics.reference_phase_deg": 0.0})
        scale = forward_model(config, 1000.0).scale
    assert why in scale.refusal
    table = _fit(optics, LINE)
    assert table["status"].tolist() == [Status.UNCALIBRATED_OPTICS.value]
    assert Status.UNCALIBRATED_OPTICS.value in table["flags"][0]


def test_a_record_survives_the_way_through_a_file() -> None:
    errors = {"names": ("focus_nm",), "matrix": ((1.5,),)}
    config = _config(**_recorded(aberrations_nm={"z11": 8.0}), **{"calibration.covariance": errors})
    again = configure(tomllib.loads(config_to_toml(config)))
    assert again == config
    with pytest.raises(ConfigError, match=r"calibration\.optics: na = 1\.6 must be below"):
        _config(**_recorded(na=1.6))


def test_a_gradient_without_a_record_is_taken_at_the_configured_optics() -> None:
    pinned = with_standards(_config())
    assert pinned.calibration is not None
    assert pinned.calibration.optics_assumed
    assert with_standards(pinned) is pinned
    assert as_given(pinned) == _config()
    learned = pinned.model_copy(
        update={"optics": pinned.optics.model_copy(update={"focus_nm": -330.0})}
    )
    assert forward_model(learned, 1000.0).scale.carried == pytest.approx(0.8789, abs=1e-4)
    assert as_given(learned) is learned
    # whether the standards had the optics of the movie nobody knows: the budget has the factor
    scale = forward_model(learned, 1000.0).scale
    sure = configure(learned, settings={f"uncertainty.{key}": 0.0 for key in _INPUTS})
    found = systematic(sure, _event(), scale=scale)["mass_kda"][0]
    assert found == pytest.approx(abs(scale.carried - 1) * MASS, rel=1e-9)


def test_calibrate_mass_keeps_the_optics_of_the_standards(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    mass = np.repeat([66.0, 146.0, 480.0], 60)
    contrast = GRADIENT * mass + 5e-5 * rng.standard_normal(mass.size)
    table = pd.DataFrame(
        {"event": range(mass.size), "contrast": contrast, "mass_kda": mass,
         "sigma_mass_kda": 1.6, "status": "ok", "flags": ""}
    )  # fmt: skip
    table.loc[::2, "status"] = Status.UNCALIBRATED_OPTICS.value  # whose contrasts are right
    folder = tmp_path / "standards.iscat"
    folder.mkdir()
    table.to_csv(folder / "fits.csv", index=False)
    learned = {"names": ("focus_nm",), "matrix": ((2.0,),)}
    config = _config(**{"optics.focus_nm": -322.0, "optics.covariance": learned,
                        "particle.height_nm": 7.0})  # fmt: skip
    (folder / "config.toml").write_text(config_to_toml(config), encoding="utf-8")
    found = mass_calibration(folder, (66.0, 146.0, 480.0), tmp_path / "line")
    assert found.events == mass.size
    written = tomllib.loads((tmp_path / "line" / "calibration.toml").read_text("utf-8"))
    used = configure(_config(), settings=written).calibration
    assert used is not None
    assert used.optics is not None
    assert (used.optics.focus_nm, used.height_nm) == (-322.0, 7.0)
    assert used.covariance == config.optics.covariance
    assert used.dof == 1
    assert not used.optics_assumed
    said = json.loads((tmp_path / "line" / "calibration.json").read_text("utf-8"))
    assert said["recorded"]["optics"]["focus_nm"] == -322.0
    (folder / "config.toml").unlink()
    told: list[str] = []
    mass_calibration(folder, (66.0, 146.0, 480.0), tmp_path / "lost", notify=told.append)
    assert "does not say with what optics" in " ".join(told)
    lost = tomllib.loads((tmp_path / "lost" / "calibration.toml").read_text("utf-8"))
    assert "optics" not in lost["calibration"]


_INPUTS = ("wavelength_nm", "n_sample", "n_glass", "height_nm", "magnification")


def _refitted(config: Config, key: str, mass: float, step: float) -> float:
    """Relative shift of the amplitude where an input of the picture is off by a step."""
    grid = PixelGrid.centred(config.fit.roi_px(PIXEL_NM), PIXEL_NM)
    bare = config.model_copy(update={"calibration": None})
    model = forward_model(bare, 3000.0)
    amplitude = float(forward_model(config, 3000.0).scale.amplitudes(mass))
    z_nm, truth, seen = 5.0, model, grid
    if key == "height_nm":
        z_nm += step
    elif key == "magnification":
        axes = (axis * (1 + step) for axis in (grid.x_nm, grid.y_nm))
        seen = PixelGrid(*axes, PIXEL_NM * (1 + step))
    else:
        value = getattr(bare.optics, key) + step
        truth = forward_model(
            bare.model_copy(update={"optics": bare.optics.model_copy(update={key: value})}), 3000.0
        )
    signal = truth.amplitude_image(seen, 0.0, 0.0, z_nm, amplitude)
    light = np.full(grid.shape, 1e8)
    likelihood = counts_likelihood(
        model, grid, light, light * (1 + signal), 1.0, background=1.0, noise=CONDITIONAL
    )
    start = np.array([0.0, 0.0, 5.0, amplitude, 0.0])
    width = np.array([150.0, 150.0, 0.0, 0.5 * abs(amplitude), 0.1])
    found = likelihood.maximize(
        start, Box(width > 0, start - width, start + width), tolerance=1e-10
    )
    return float(found.theta[3] / amplitude - 1)


@pytest.mark.parametrize("key", _INPUTS)
def test_an_input_that_is_off_moves_masses_as_refits_do(key: str) -> None:
    """Standards with another focus: the difference of the refits here and there remains."""
    only = {f"uncertainty.{other}": 0.0 for other in _INPUTS if other != key}
    config = _config(**only, **_recorded(focus_nm=-240.0))
    there = _config(**{"optics.focus_nm": -240.0})
    sigma = float(getattr(config.uncertainty, key))
    here, back = (
        (_refitted(*each, 0.05 * sigma) - _refitted(*each, -0.05 * sigma)) / 0.1
        for each in ((_config(), key, MASS), (there, key, 1.0))  # standards are faint
    )
    found = systematic(config, _event())["mass_kda"][0] / MASS
    assert found == pytest.approx(abs(here - back), rel=0.02, abs=2e-6)
    assert abs(here) > 1e-3  # what would be there without standards
    # standards of the same set-up take it away, and a zero turns it off
    assert systematic(_config(**only, **_recorded()), _event()) == {}
    off = configure(config, settings={f"uncertainty.{key}": 0.0})
    assert systematic(off, _event()) == {}
    # a gradient from elsewhere has the error of the model's contrast per amplitude
    elsewhere = systematic(with_standards(_config(**only)), _event())["mass_kda"][0] / MASS
    assert elsewhere > 0


def test_the_budget_adds_up_to_the_column() -> None:
    config = _config(
        **_recorded(focus_nm=-270.0),
        **{"calibration.gradient_se_per_kda": 0.01 * abs(GRADIENT), "calibration.dof": 1,
           "calibration.covariance": {"names": ("focus_nm",), "matrix": ((4.0,),)},
           "optics.covariance": {"names": ("focus_nm",), "matrix": ((1.0,),)}},
    )  # fmt: skip
    table = _event()
    found = contributions(config, table)
    budget = budget_of(table, found, {}, unknown=None, scaled=False)
    shared = [one for one in budget if one["common"]]
    whole = float(np.sqrt(sum(one["sigma_mass_kda"] ** 2 for one in shared)))
    assert whole == pytest.approx(total(found, 1)["mass_kda"][0], rel=1e-9)
    kinds = {one["name"]: one["kind"] for one in budget}
    assert kinds["photon noise"] == "measured"
    assert kinds["optics of the movie"] == kinds["optics of the standards"] == "learned"
    assert kinds["wavelength"] == "assumed"
    sizes = {one["name"]: one["sigma_rel"] for one in budget}
    assert sizes["line of the standards"] == pytest.approx(0.01, rel=1e-6)
    # two nanometres of focus there are worth more than one here
    assert sizes["optics of the standards"] > sizes["optics of the movie"] > 1e-4
    assert next(one for one in budget if one["name"] == "line of the standards")["dof"] == 1
    own = table["sigma_mass_kda"].item() ** 3 / table["mass_kda"].item() ** 2
    assert explained_kda(budget) == pytest.approx(own)  # of the bias that is taken off


MEASURED: dict[str, Any] = {
    "gain_e_per_adu": {"value": 4.0, "se": 0.1, "from": "measured"},
    "offset_adu": {"value": 100.0, "se": 12.0, "from": "dark frames"},
    "light_adu": 2000.0,
    "law": {"kind": "linear", "contrast": 1.0, "contrast_se": 0.004},
}


@pytest.mark.parametrize(
    ("offset", "expected"),
    [
        ({}, {"offset of the camera": (0.006, "measured"), "linearity": (0.004, "measured")}),
        # the same number: the offset is from the law of the counts
        ({"from": "measured"}, {"offset of the camera": (0.006, "measured")}),
        ({"from": "assumed"}, {"offset of the camera": (0.006, "assumed")}),
        # nobody says how well a configured one is known: one count of 2000
        (
            {"from": "configured", "se": 0.0},
            {"offset of the camera": (0.0005, "assumed"), "linearity": (0.004, "measured")},
        ),
    ],
)
def test_the_budget_has_the_camera(
    offset: dict[str, Any], expected: dict[str, tuple[float, str]]
) -> None:
    camera = {**MEASURED, "offset_adu": MEASURED["offset_adu"] | offset}
    found = contributions(_config(), _event(), summary={"camera": camera})
    budget = budget_of(_event(), found, {}, unknown=None, scaled=False)
    lines = {one["name"].split(",")[0]: one for one in budget if "camera" in one["name"]}
    assert lines.pop("gain of the camera")["sigma_rel"] == 0  # it changes sigma alone
    gain = [(source, errors) for source, errors in found if source.name == "gain of the camera"]
    assert total(gain, 1) == {}  # and nothing is said to be known
    shares = np.hypot.reduce([size for size, _ in expected.values()])
    contrast = abs(float(_event()["contrast"][0]))
    for config in (_config(), _config().model_copy(update={"calibration": None})):
        whole = contributions(config, _event(), summary={"camera": camera})
        told = total([each for each in whole if "camera" in each[0].name], 1).get("contrast")
        assert told == (None if config.calibration else pytest.approx(shares * contrast))
    said = {name.removesuffix(" of the camera") if "lin" in name else name: one
            for name, one in lines.items()}  # fmt: skip
    assert {name: (one["sigma_rel"], one["kind"]) for name, one in said.items()} == {
        name: (pytest.approx(size, rel=1e-9), kind) for name, (size, kind) in expected.items()
    }


@pytest.mark.parametrize("over", [0.0, 1.0, 2.0, 6.0])
def test_what_passes_a_threshold_is_too_large_by_what_the_budget_says(over: float) -> None:
    """Against draws of a Gaussian, of which what is beneath the threshold is lost."""
    table = _event().assign(snr=5.0 + over)
    found = dict(contributions(_config(), table, threshold_snr=5.0))
    said = next((each for source, each in found.items() if "threshold" in source.name), None)
    draws = over + np.random.default_rng(1).standard_normal(200_000)
    kept = draws[draws > 0]
    shift, error = float(kept.mean()) - over, float(kept.std()) / np.sqrt(kept.size)
    size = 0.0 if said is None else said["mass_kda"][0] / table["sigma_mass_kda"].item()
    assert abs(size - shift) < 4 * error
    assert (said is None) == (over > 3)


def test_a_width_that_nothing_explains_is_said() -> None:
    one = {"mass_kda": 92.0, "width_kda": 5.0, "width_low": 4.0, "width_high": 6.0, "count": 50,
           "spread_over_sigma": 1.5, "explained_kda": 0.0}  # fmt: skip
    found = wide_species([one], calibrated=True)
    assert found is not None
    assert "92 kDa is wider than the budget explains: 5.4 %" in found.text
    assert wide_species([one | {"explained_kda": 4.5}], calibrated=True) is None
    assert wide_species([one | {"width_low": 0.5}], calibrated=True) is None


def _pictures(share: float, noise: float, *, seed: int) -> pd.DataFrame:
    """Invent rows of three brightnesses whose pictures the model describes but for a share."""
    rng = np.random.default_rng(seed)
    snr = np.repeat([19.0, 43.0, 90.0], 12)
    expected = noise + (share * snr) ** 2 / 1024
    chi2 = expected + np.sqrt(2 / 1024) * rng.standard_normal(snr.size)
    return pd.DataFrame({"status": "ok", "chi2_reduced": chi2, "snr": snr})


def test_what_is_left_over_of_pictures_is_an_error_of_masses() -> None:
    """A focus 30 nm away left over a quarter of the pictures; masses were 4 % off."""
    assert misfit_error(_pictures(0.26, 1.0, seed=1), 1024) == pytest.approx(0.104, rel=0.1)
    for seed in range(200):
        assert misfit_error(_pictures(0.0, 1.0, seed=seed), 1024) == 0.0
        # noise that is ten per cent more than the camera's numbers say is no misfit
        assert misfit_error(_pictures(0.0, 1.1, seed=seed), 1024) == 0.0
