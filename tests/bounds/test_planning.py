"""Scans, the best setting, the price of a precision and its budget."""

from __future__ import annotations

import math

import numpy as np
import pytest
from golden_setups import small_config

from iscat_analysis.bounds import (
    AXES,
    bounds_report,
    budget,
    changed,
    effort,
    findings_of,
    optimize,
    parse_scan,
    parse_target,
    plan,
    scan,
)
from iscat_analysis.config import Config
from iscat_analysis.errors import ConfigError
from iscat_analysis.records import PARAMETERS


def protein(**sections: dict[str, object]) -> Config:
    values: dict[str, dict[str, object]] = {
        "particle": {"diameter_nm": 8.0, "permittivity": (2.1316, 0.0), "height_nm": 5.0},
        "camera": {"pixel_size_nm": 80.0, "samples_per_pixel": 3, "read_noise_e": 20.0,
                   "frame_rate_hz": 100.0},
        "bounds": {"pixels": 25, "n_before": 100, "n_after": 100, "photons_per_pixel": 1e4},
    }  # fmt: skip
    for name, keys in sections.items():
        values.setdefault(name, {}).update(keys)
    return small_config(**values)


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("z=0:2000:500", [0, 500, 1000, 1500, 2000]),
        ("focus=100:-100:-100", [100, 0, -100]),
        ("z=0:10:4", [0, 4, 8]),
        ("attenuation=1,0.3,0.1", [1, 0.3, 0.1]),
        (" NA = 1.2:1.3:0.05", [1.2, 1.25, 1.3]),
        ("fov=2000", [2000]),
    ],
)
def test_scan_syntax(text: str, values: list[float]) -> None:
    assert parse_scan(text)[1] == pytest.approx(values)


@pytest.mark.parametrize(
    ("text", "remedy"),
    [
        ("z", "as in `scan` = z=0:2000:50"),
        ("height=0:1:1", "NAME one of z, focus, attenuation, na, pixel, fov, photons"),
        ("z=0:1", "needs three numbers"),
        ("z=a:b:c", "as in `scan` = z=0:2000:50"),
        ("z=0:100:-10", "change its sign"),
        ("z=0:100:0", "change its sign"),
        ("z=0:nan:1", "finite"),
        ("z=0:1e9:1", "take a larger step"),
        ("z=1,2:3", "needs three numbers"),
        ("z=", "as in `scan` = z=0:2000:50"),
    ],
)
def test_bad_scan_syntax_gets_one_line(text: str, remedy: str) -> None:
    with pytest.raises(ConfigError, match=remedy) as caught:
        parse_scan(text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    ["z=0,150", "focus=-400,300", "attenuation=1,0.2", "na=1.2,1.4", "pixel=60,110",
     "fov=1000,2400", "photons=500,2e4"],
)  # fmt: skip
def test_a_scan_is_the_reports_along_it(text: str) -> None:
    config = protein(optics={"n_immersion": 1.515, "n_glass": 1.515})
    axis, values = parse_scan(text)
    said: list[tuple[int, int]] = []
    found = scan(config, axis, values, progress=lambda _, done, total: said.append((done, total)))
    assert said[-1] == (2, 2)
    assert found.here == pytest.approx(axis.value(config))
    for (_, row), value in zip(found.table.iterrows(), values, strict=True):
        report = bounds_report(changed(config, axis, value))
        for kind in ("crb_single", "crb_joint", "qcrb"):
            for name in PARAMETERS:
                assert row[f"{kind}_{name}"] == pytest.approx(report["actual"][kind][name], 1e-8)
        assert row["n_camera"] == pytest.approx(report["n_scattered"]["camera"], 1e-8)


def test_attenuation_and_pixels_leave_the_scattered_light_alone() -> None:
    config = protein()
    for text in ("attenuation=1,0.1", "pixel=40,80"):
        found = scan(config, *parse_scan(text)).table
        assert found["n_collected"].iloc[0] == pytest.approx(found["n_collected"].iloc[1])


def test_a_calibration_stays_at_its_optics() -> None:
    """The focus changes how a mass looks, not how strongly it scatters."""
    config = protein(calibration={"gradient_per_kda": 1e-4}, bounds={"n_before": 0})
    found = scan(config, *parse_scan("focus=300,-400,900")).table
    assert np.allclose(found["n_collected"], found["n_collected"][0], rtol=1e-9)
    assert np.isfinite(found["crb_joint_mass_kda"]).all()


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("z=-5,5", "bounds.z_nm"),
        ("na=1.6", "na = 1.6 must be below n_immersion"),
        ("photons=0", "bounds.photons_per_pixel"),
        ("attenuation=-1", "optics.attenuation"),
        ("attenuation=0", 'use scheme = "darkfield"'),
        ("fov=10", "bounds.pixels"),
        ("pixel=0", "camera.pixel_size_nm"),
    ],
)
def test_impossible_values_name_the_key(text: str, key: str) -> None:
    with pytest.raises(ConfigError, match=key) as caught:
        scan(protein(), *parse_scan(text))
    assert "\n" not in str(caught.value)


def test_dark_field_has_nothing_to_attenuate() -> None:
    config = protein(optics={"scheme": "darkfield"})
    with pytest.raises(ConfigError, match="no reference to attenuate"):
        scan(config, *parse_scan("attenuation=1,0.1"))


@pytest.mark.parametrize("target", ["mass", "z", "x"])
def test_the_best_focus_is_better_than_any_of_a_dense_scan(target: str) -> None:
    config = protein()
    best = optimize(config, "focus", target)
    column = f"crb_joint_{best.parameter}"
    dense = scan(config, AXES["focus"], np.arange(-1000.0, 1000.0, 20.0)).table[column]
    assert best.bound <= dense.min() * (1 + 1e-6)
    assert best.bound < best.bound_here
    there = plan(changed(config, AXES["focus"], best.value)).bounds(PARAMETERS)
    assert there.crb_joint[PARAMETERS.index(best.parameter)] == pytest.approx(best.bound)


def test_a_small_well_asks_for_attenuation_and_read_noise_against_it() -> None:
    free = optimize(protein(), "attenuation", "mass")
    assert free.value == pytest.approx(1.0)  # nothing is gained by weakening the reference
    well = optimize(protein(camera={"well_depth_e": 2000.0}), "attenuation", "mass")
    assert 0.3 < well.value < math.sqrt(0.2)  # as strong as the well allows: β² 10⁴ < 2000


@pytest.mark.parametrize(
    ("axis", "target", "mode", "message"),
    [
        ("focus", "z", "mass", 'not free in mode mass: choose fit.mode = "joint"'),
        ("focus", "colour", "joint", "choose one of x, y, z, mass"),
        ("na", "mass", "joint", "choose focus or attenuation"),
    ],
)
def test_bad_optimisations_say_what_to_do(axis: str, target: str, mode: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        optimize(protein(fit={"mode": mode}), axis, target)  # type: ignore[arg-type]


@pytest.mark.parametrize("parameter", PARAMETERS)
def test_the_budget_multiplies_up_to_the_bound(parameter: str) -> None:
    config = protein()
    lines = budget(config, parameter)
    report = bounds_report(config)["actual"]
    total = math.prod(line.factor for line in lines)
    assert lines[0].bound == pytest.approx(report["qcrb"][parameter], rel=1e-9)
    assert lines[-1].bound == pytest.approx(report["crb_joint"][parameter], rel=1e-12)
    assert total * lines[0].bound == pytest.approx(lines[-1].bound, rel=1e-12)
    cost = {line.cause: line.factor for line in lines}
    assert cost["finite background"] == pytest.approx(math.sqrt(2), rel=1e-3)
    assert cost["read noise"] == pytest.approx(math.sqrt(1 + 400 / 1e4), rel=1e-3)
    assert 1.0 < cost["pixelation"] < 1.2
    assert cost["shot noise"] > 1
    assert cost["crosstalk"] > 0.999999


@pytest.mark.parametrize("text", ["mass=30kDa", "mass=0.03MDa", "z=20", "x=40nm"])
def test_the_frames_of_a_target_reach_it_and_one_less_does_not(text: str) -> None:
    config = protein()
    goal = parse_target(text, config)
    ways = effort(config, goal)
    assert [way.background for way in ways] == [
        "100 frames before", "as many frames before as after", "known",
    ]  # fmt: skip
    for way in ways:
        if not math.isfinite(way.n_after):
            continue
        bounds = []
        for n in (way.n_after, way.n_after * 0.999 - 1):
            before = n if way.background.startswith("as many") else way.n_before
            values = config.model_dump(exclude_none=True)
            values["bounds"].update(n_after=max(1, int(n)), n_before=int(before))
            found = plan(Config.model_validate(values)).bounds(PARAMETERS)
            bounds.append(found.crb_joint[PARAMETERS.index(goal.parameter)])
        assert bounds[0] <= goal.value * (1 + 1e-9)
        assert bounds[1] > goal.value or way.n_after == 1
    equal, known = ways[1], ways[2]
    assert equal.n_after / known.n_after == pytest.approx(2, rel=0.02, abs=1.01)
    assert equal.seconds == pytest.approx(2 * equal.n_after / 100)


def test_a_short_background_can_be_never_enough() -> None:
    config = protein(bounds={"n_before": 3})
    first = effort(config, parse_target("mass=1kDa", config))[0]
    assert math.isinf(first.n_after)
    assert first.seconds is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mass", "write it as mass=5kDa"),
        ("mass=0", "positive number of kDa"),
        ("mass=5nm", "positive number of kDa"),
        ("z=1e", "positive number of nm"),
        ("colour=3", "choose one of"),
    ],
)
def test_bad_targets_say_what_to_do(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_target(text, protein())


def test_an_unidentifiable_target_is_refused() -> None:
    config = protein(camera={"pixel_size_nm": 150.0, "samples_per_pixel": 1}, bounds={"pixels": 2})
    with pytest.raises(ConfigError, match="unidentifiable"):
        effort(config, parse_target("mass=1kDa", config))


def test_saturation_and_coarse_sampling_are_said() -> None:
    full = plan(protein(camera={"well_depth_e": 9000.0}))
    assert [each.code for each in findings_of(full)] == ["saturated-plan"]
    coarse = plan(
        protein(camera={"pixel_size_nm": 800.0, "samples_per_pixel": 1}, bounds={"pixels": 5})
    )
    assert "coarse-sampling" in [each.code for each in findings_of(coarse)]
    assert findings_of(plan(protein())) == []


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"camera": {"pixel_size_nm": None}}, "camera.pixel_size_nm is missing"),
        ({"camera": {"read_noise_e": "map.tif"}}, "is a map: bounds need a number"),
        ({"bounds": {"x_nm": 5000.0}}, "lies outside the field"),
    ],
)
def test_plan_says_what_is_missing(sections: dict[str, dict[str, object]], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        plan(protein(**sections))


def test_heights_outside_the_range_of_the_fit_are_exact() -> None:
    """`fit.z_range_nm` bounds a fit, not what may be planned."""
    wide = protein(particle={"height_nm": 500.0}, bounds={"z_nm": 20.0})
    narrow = protein(
        particle={"height_nm": 500.0}, bounds={"z_nm": 20.0}, fit={"z_range_nm": (400.0, 600.0)}
    )
    a, b = (bounds_report(config)["actual"]["crb_joint"] for config in (wide, narrow))
    assert list(a.values()) == pytest.approx(list(b.values()), rel=1e-9)
    found = scan(narrow, *parse_scan("z=20,800")).table
    assert found["crb_joint_z_nm"][0] == pytest.approx(a["z_nm"], rel=1e-7)
