"""The best pupil: known cases, limits of the camera, and the claim confirmed from its file."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from iscat_analysis.bounds import bounds_report, natural_bound, optimize_pupil, plan
from iscat_analysis.config import Config, load_config, parse_config
from iscat_analysis.errors import ConfigError
from iscat_analysis.records import PARAMETERS
from iscat_analysis.report.bounds import design_toml


def setup(**sections: dict[str, Any]) -> Config:
    """Put a faint protein close to the glass, seen by a modest aperture."""
    values: dict[str, dict[str, Any]] = {
        "optics": {"na": 1.2, "focus_nm": 100.0},
        "camera": {"pixel_size_nm": 100.0},
        "particle": {"mass_kda": 100.0},
        "bounds": {"pixels": 31, "n_before": 0, "photons_per_pixel": 1e4},
    }
    for name, keys in sections.items():
        values.setdefault(name, {}).update(keys)
    return parse_config(values)


def flat() -> Config:
    """Close the pupil until particle and reference are two plane waves.

    Pixels are points, in which nothing is lost: a mean over 800 nm loses 8 % of the information.
    """
    return setup(
        optics={"na": 0.15, "focus_nm": 5.0},
        camera={"pixel_size_nm": 800.0, "samples_per_pixel": 1},
        bounds={"pixels": 101},
    )


def with_phase(config: Config, degrees: float) -> Config:
    optics = config.optics.model_copy(update={"reference_phase_deg": degrees})
    return config.model_copy(update={"optics": optics})


def test_mass_reaches_the_quantum_bound_at_the_phase_of_the_image() -> None:
    """Homodyne detection: J_mm/K_mm is cos² of the phase between particle and reference."""
    config = flat()
    experiment = plan(config)
    middle = experiment.grid.shape[0] // 2
    cosine, sine = (
        plan(with_phase(config, phase)).model.image(
            experiment.grid, 0.0, 0.0, 5.0, experiment.mass_kda
        )[middle, middle]
        for phase in (0.0, 90.0)
    )  # contrast ∝ cos(ψ − φ), known without any search
    found = optimize_pupil(config, ["mass_kda"], free=["phase"], starts=2, seed=1)
    phase = found.settings["reference_phase_deg"][1]
    away = math.degrees(math.atan2(sine, cosine)) - phase
    assert abs(math.remainder(away, 180.0)) < 0.5
    seen = experiment.on_camera / experiment.collected  # the field cuts the Airy rings
    assert found.holevo == pytest.approx(1.0, rel=1e-4)
    assert found.shares["best"] == pytest.approx(seen, rel=2e-3)
    assert seen > 0.97
    for turned in (45.0, 60.0):  # and elsewhere it is not reached
        report = bounds_report(with_phase(config, phase + turned))
        share = report["information_fraction"]["mass_kda"]
        assert share == pytest.approx(seen * math.cos(math.radians(turned)) ** 2, rel=0.02)


def test_attenuation_fills_the_well_and_no_more() -> None:
    """With read noise the reference cannot be too strong, until the well is full."""
    noisy = {"pixel_size_nm": 100.0, "read_noise_e": 60.0}
    open_well = optimize_pupil(
        setup(camera=noisy, optics={"attenuation": 0.3}), ["mass_kda"], free=["attenuation"],
        starts=2,
    )  # fmt: skip
    assert open_well.settings["attenuation"][1] > 0.99
    well = optimize_pupil(
        setup(camera=noisy | {"well_depth_e": 4e3}), ["mass_kda"], free=["attenuation"], starts=2
    )
    assert 0.97 * 4e3 < well.peak_e < 4e3
    assert well.settings["attenuation"][1] == pytest.approx(math.sqrt(0.4), rel=0.03)
    # what the read noise costs, by arithmetic: variance over signal² ∝ (B + σ²)/B
    strong, weak = (60.0**2 / o.config.bounds.photons_per_pixel for o in (open_well, well))
    worse = well.sums["best"] / open_well.sums["best"]
    assert worse == pytest.approx((1 + weak) / (1 + strong), rel=0.01)


def test_the_light_and_its_bound_do_not_depend_on_the_pupil() -> None:
    config = setup(fit={"mode": "joint"}, bounds={"pixels": 25})
    other = parse_config(
        {
            **config.model_dump(exclude_none=True),
            "optics": {
                **config.optics.model_dump(exclude_none=True),
                "attenuation": 0.2, "reference_phase_deg": 70.0, "focus_nm": -250.0,
                "aberrations_nm": {"z6": 12.0, "z11": -9.0},
            },
            "bounds": {
                **config.bounds.model_dump(exclude_none=True), "photons_per_pixel": 1e4 * 0.04,
            },
        }
    )  # fmt: skip
    before, after = plan(config), plan(other)
    assert after.collected == pytest.approx(before.collected, rel=1e-12)
    assert np.allclose(after.quantum, before.quantum, rtol=1e-12, atol=0)
    assert natural_bound(after.quantum).sum == pytest.approx(natural_bound(before.quantum).sum)


def test_height_and_mass_together_confirmed(tmp_path: Path) -> None:
    """Against a grid of focus and phase, and from the file that is written."""
    config = setup(
        fit={"mode": "joint"},
        camera={"well_depth_e": 1e5},
        calibration={"gradient_per_kda": 3e-5},
        optics={"focus_nm": 400.0},
    )
    found = optimize_pupil(config, ["z_nm", "mass_kda"], free=["focus", "phase"], starts=4, seed=2)
    assert 1.0 >= found.shares["best"] > found.shares["configured"]
    assert found.holevo > 2.0  # the two are in conflict
    path = tmp_path / "optics.toml"
    path.write_text(design_toml(found), encoding="utf-8")
    read = load_config(path)
    report = bounds_report(read)
    actual = report["actual"]
    for name in found.chosen:
        assert actual["crb_joint"][name] == pytest.approx(found.sigma[name]["best"], rel=1e-9)
        assert actual["qcrb"][name] == pytest.approx(found.sigma[name]["qcrb"], rel=1e-9)
    total = sum((actual["crb_joint"][n] / actual["qcrb"][n]) ** 2 for n in found.chosen)
    assert found.holevo / total == pytest.approx(found.shares["best"], rel=1e-9)
    light = np.asarray(report["qfi"]) + 1j * np.asarray(report["qfi_imaginary"])
    # W = K, which has the small term K_zm that diag(K) leaves out
    assert found.holevo == pytest.approx(natural_bound(light[2:, 2:]).sum, rel=0.01)
    # as [optics] file it brings the same optics
    borrowed = load_config(None, [f"optics.file={str(path)!r}", "camera.pixel_size_nm=100"])
    assert borrowed.optics.focus_nm == read.optics.focus_nm
    assert borrowed.optics.reference_phase_deg == read.optics.reference_phase_deg
    best = math.inf
    at = [PARAMETERS.index(name) for name in found.chosen]
    for focus in np.arange(-1900.0, 1901.0, 100.0):
        for phase in np.arange(0.0, 360.0, 20.0):
            optics = read.optics.model_copy(
                update={"focus_nm": float(focus), "reference_phase_deg": float(phase)}
            )
            bounds = plan(read.model_copy(update={"optics": optics})).bounds(PARAMETERS)
            ratio = (bounds.crb_joint[at] / bounds.qcrb[at]) ** 2
            best = min(best, float(ratio.sum()))
    assert found.sums["best"] <= best * 1.0005
    assert best < 1.1 * found.sums["best"]  # the grid is near enough to be a test


@pytest.mark.parametrize(
    ("sections", "arguments", "message"),
    [
        ({"optics": {"scheme": "darkfield"}}, {}, "dark field has no reference"),
        ({}, {"chosen": ["z_nm"]}, "not free in mode mass"),
        ({}, {"free": ["colour"]}, "choose among focus, phase"),
        ({"camera": {"well_depth_e": 100.0}}, {"free": ["phase"]}, "camera saturates"),
    ],
)
def test_refusals(sections: dict[str, Any], arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        optimize_pupil(setup(**sections), **arguments)
