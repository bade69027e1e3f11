"""The configuration: nearest keys, impossible values, and the way to TOML and back."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iscat_analysis.config import (
    SIMULATED,
    Config,
    Mode,
    Section,
    config_to_toml,
    load_config,
    parse_config,
)
from iscat_analysis.errors import ConfigError

positive = st.floats(1e-3, 1e6)
finite = st.floats(-1e6, 1e6)


def _complaint(*overrides: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load_config(None, overrides)
    text = str(caught.value)
    assert "\n" not in text
    return text


# ---- keys ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        (
            "optics.wavelenght_nm=525",
            "unknown key optics.wavelenght_nm; did you mean wavelength_nm?",
        ),
        ("camera.pixelsize=84", "did you mean pixel_size_nm?"),
        ("fit.mod=mass", "did you mean mode?"),
        ("optic.na=1.4", "unknown section optic; did you mean optics?"),
        ("posterior.walker=32", "did you mean walkers?"),
        ("calibration.gradient=1", "did you mean gradient_per_kda?"),
        ("optics.NA=1.4", "unknown key optics.NA; did you mean na?"),
        ("optics.pixel_size_nm=84", "did you mean camera.pixel_size_nm?"),
        ("camera.wavelength_nm=525", "did you mean optics.wavelength_nm?"),
        ("camera.offset=100", "did you mean offset_adu?"),  # not calibration.offset
        ("camera.frames=[0, 9]", "did you mean background.frames or fit.frames or simulation."),
        ("fit.background=[0, 9]", "did you mean section [background]?"),
        ("optics.magnification=60", "known: file, wavelength_nm"),  # not attenuation
    ],
)
def test_unknown_keys_name_the_nearest(override: str, expected: str) -> None:
    assert expected in _complaint(override)


def test_a_key_like_no_other_lists_the_known_ones() -> None:
    assert "known: workers, memory_limit_mb" in _complaint("compute.zzzzzz=1")


def test_an_unknown_key_of_an_event_is_found() -> None:
    with pytest.raises(ConfigError, match=r"events\.0\.xpx; did you mean x_px"):
        parse_config({"simulation": {"events": [{"frame": 1, "xpx": 1.0, "y_px": 2.0}]}})


def test_a_number_that_is_too_small_is_not_told_to_be_a_text() -> None:
    assert _complaint("camera.gain_e_per_adu=0").count("camera.gain_e_per_adu") == 1
    assert _complaint("camera.read_noise_e=[1]").count("camera.read_noise_e") == 2


def test_every_complaint_is_in_the_one_line() -> None:
    text = _complaint("optics.nna=1", "fit.roi_nm=-3")
    assert "optics.nna" in text
    assert "fit.roi_nm" in text


# ---- values ----------------------------------------------------------------------------------

IMPOSSIBLE = [
    (["optics.na=1.6"], "na = 1.6 must be below n_immersion"),
    (["optics.na=1.515"], "na = 1.515 must be below n_immersion"),
    (["calibration.gradient_per_kda=-3.1"], "gradient_per_kda = -3.1 is not between 1e-07 and"),
    (["calibration.gradient_per_kda=-3.1e-8"], "as -3.1e-5, not in per cent or ppm, nor per Da"),
    (["optics.n_sample=133"], "n_sample: a refractive index of 133 is not between 1 and 4.5"),
    (["optics.attenuation=10"], "attenuation = 10 is more than 3: it is the part"),
    (["optics.na=1.45", "optics.n_glass=1.4"], "must be below n_glass"),
    (["optics.na=1.2", "optics.n_sample=1.515"], "no iSCAT reference"),
    (["optics.attenuation=0"], 'use scheme = "darkfield"'),
    (["optics.wavelength_nm=-525"], "optics.wavelength_nm"),
    (["optics.focus_nm=nan"], "optics.focus_nm"),
    (["optics.focus_nm=inf"], "optics.focus_nm"),
    (["optics.scheme=iskat"], "optics.scheme"),
    (["optics.wavelength_nm=0.525"], "if 0.525 is in micrometres, write 525"),
    (["optics.wavelength_nm=5.25e-7"], "if 5.25e-07 is in metres, write 525"),
    (["optics.wavelength_nm=5.25"], "5.25 nm is not between 200 and 3000 nm"),
    (["optics.focus_nm=3e6"], "not between 0 and 100000 nm"),
    (["optics.na=1,42"], "optics.na: write 1.42, with a decimal point"),
    (["fit.roi_nm=2.7"], "if 2.7 is in micrometres, write 2700"),
    (["fit.roi_nm=100"], "smaller than 131.25 nm, a pixel or a quarter of the wavelength"),
    (["fit.roi_nm=1e9"], "fit.roi_nm"),
    (["fit.z_range_nm=[0, 1e9]"], "fit.z_range_nm"),
    (["particle.diameter_nm=3e7"], "particle.diameter_nm"),
    (["posterior.walkers=1000000"], "posterior.walkers"),
    (["posterior.enabled=perhaps"], "posterior.enabled"),
    (["simulation.shape=[1000000, 1000000]"], "simulation.shape"),
    (["background.method=sliding", "background.frames=[0, 9]"], "leave frames out"),
    (["background.method=tracks"], 'is made of what fit.mode = "track" finds'),
    (["fit.mode=track", "background.method=tracks", "background.frames=[0,9]"], "leave frames out"),
    (["track.free=all"], "track.free"),
    (["optics.focus_nm=-300000"], "the magnitude of -300000 nm is not between 0 and 100000 nm"),
    (["track.max_step_nm=0.6"], "0.6 nm is not between 1 and 100000 nm"),
    (["track.memory_frames=-1"], "track.memory_frames"),
    (["track.min_frames=0"], "track.min_frames"),
    (["track.viscosity_mpa_s=0"], "track.viscosity_mpa_s"),
    (["track.temperature_c=-300"], "track.temperature_c"),
    (["track.temperature_c=298.15"], "and 250 °C; if that is in kelvin, write 25"),
    (["track.viscosity_mpa_s=0.00089"], "if 0.00089 is in Pa·s, write 0.89"),
    (["background.frames=200"], "[start, stop)"),
    (["camera.pixel_size_nm=0"], "camera.pixel_size_nm"),
    (["camera.pixel_size_nm=84400"], "84400 nm is not between 1 and 2000 nm"),
    (["camera.pixel_size_nm=0.0844"], "0.0844 nm is not between 1 and 2000 nm"),
    (["camera.gain_e_per_adu=-1"], "camera.gain_e_per_adu"),
    (["camera.samples_per_pixel=10"], "camera.samples_per_pixel"),
    (["particle.kind=custom"], "needs permittivity or index"),
    (["particle.kind=custom", "particle.index=1.5"], "needs density_kg_m3"),
    (["particle.height_nm=-1"], "particle.height_nm"),
    (["background.frames=[200, 100]"], "start < stop"),
    (["background.frames=[0]"], "background.frames"),
    (["background.method=known"], "needs level_e"),
    (["fit.frames=[-1, 5]"], "start < stop"),
    (["fit.mode=masses"], "fit.mode"),
    (["fit.z_range_nm=[100, 100]"], "is empty"),
    (["detection.false_alarms_per_movie=0"], "detection.false_alarms_per_movie"),
    (["posterior.walkers=11"], "posterior.walkers"),
    (["posterior.walkers=8"], "posterior.walkers"),
    (["posterior.steps=1"], "posterior.steps"),
    (["fit.mode=mass", "posterior.prior_z_nm=[5, 2]"], "posterior.prior_z_nm is of a parameter"),
    (["posterior.prior_mass_kda=[66, 0]"], "posterior.prior_mass_kda"),
    (["calibration.gradient_per_kda=0"], "says nothing about mass"),
    (["calibration.offset=0.1"], "calibration.gradient_per_kda: is required"),
    (["simulation.count=3", "simulation.leavings=4"], "needs a count at least as large"),
    (["simulation.seed=-1"], "simulation.seed"),
    (["bounds.pixels=1"], "bounds.pixels"),
    (["compute.workers=0"], "compute.workers"),
    (["compute.workers=many"], "compute.workers"),
    (["na=1.4"], "write it as section.key=value"),
    (["optics.na"], "write it as section.key=value"),
    (["=3"], "write it as section.key=value"),
]


@pytest.mark.parametrize(("overrides", "expected"), IMPOSSIBLE)
def test_impossible_values_give_one_line(overrides: list[str], expected: str) -> None:
    assert expected in _complaint(*overrides)


@pytest.mark.parametrize(
    ("event", "expected"),
    [
        ({"frame": 0, "x_px": 200.0, "y_px": 5.0}, "outside the field"),
        ({"frame": 400, "x_px": 5.0, "y_px": 5.0}, "appears at frame 400"),
        ({"frame": 9, "leave": 9, "x_px": 5.0, "y_px": 5.0}, "must come after"),
        ({"x_px": 5.0, "y_px": 5.0}, "frame: is required"),
    ],
)
def test_impossible_events_give_one_line(event: dict[str, float], expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        parse_config({"simulation": {"events": [event]}})


@pytest.mark.parametrize(
    ("particle", "expected"),
    [
        ({"mass_kda": 1.0, "diameter_nm": 1.0}, "mass_kda or diameter_nm"),
        ({"permittivity": [2.0, 0.0], "index": 1.4}, "permittivity or index"),
    ],
)
def test_what_says_the_same_twice_is_refused_in_a_file(
    particle: dict[str, object], expected: str
) -> None:
    with pytest.raises(ConfigError, match=expected):
        parse_config({"particle": particle})


def test_a_configuration_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="frozen"):
        load_config().optics.na = 1.0  # type: ignore[misc]


# ---- files -----------------------------------------------------------------------------------


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    broken = tmp_path / "broken.toml"
    for content, expected in [(b"[optics\n", "not valid TOML"), (b"\xff\xfe", "UTF-8")]:
        broken.write_bytes(content)
        with pytest.raises(ConfigError, match=expected):
            load_config(broken)
    with pytest.raises(ConfigError, match="cannot be read"):
        load_config(tmp_path / "absent.toml")


def test_relative_paths_are_relative_to_the_file(tmp_path: Path) -> None:
    path = tmp_path / "setup.toml"
    path.write_text('[camera]\ngain_e_per_adu = "gain.tif"\n[simulation]\nbackground = "flat"\n')
    config = load_config(path)
    assert config.camera.gain_e_per_adu == str(tmp_path / "gain.tif")
    assert config.simulation.background == "flat"


@pytest.mark.parametrize(
    ("override", "value"),
    [("fit.mode=joint", "joint"), ('fit.mode="joint"', "joint"), ("fit.mode= joint ", "joint")],
)
def test_quotes_may_be_left_out(override: str, value: str) -> None:
    assert load_config(None, [override]).fit.mode == value


def test_overrides_win_over_the_file_and_the_last_wins(sample_configs: dict[str, Path]) -> None:
    config = load_config(sample_configs["mass"], ["optics.na=1.3", "optics.na=1.35"])
    assert config.optics.na == 1.35


# ---- TOML and back ---------------------------------------------------------------------------


DIPOLE_MODES = [mode for mode in get_args(Mode) if mode != "size"]  # which needs a sphere


@st.composite
def configurations(draw: st.DrawFn) -> Config:
    """Draw valid configurations that exercise each kind of value."""
    start = draw(st.integers(0, 1000))
    frames = [start, start + draw(st.integers(1, 1000))]
    rows, columns = draw(st.tuples(st.integers(8, 500), st.integers(8, 500)))
    events = draw(
        st.lists(
            st.fixed_dictionaries(
                {
                    "frame": st.integers(0, 399),
                    "x_px": st.floats(-0.5, columns - 0.51),
                    "y_px": st.floats(-0.5, rows - 0.51),
                },
                optional={"z_nm": st.floats(0, 1e4), "mass_kda": positive},
            ),
            max_size=3,
        )
    )
    text = st.text(st.characters(blacklist_categories=("Cs", "Cc")), min_size=1, max_size=12)
    values = {
        "optics": {
            "focus_nm": draw(st.floats(-1e5, 1e5)),
            "polarization_deg": draw(finite),
            "scheme": draw(st.sampled_from(["iscat", "cobri", "darkfield"])),
        },
        "camera": {
            "pixel_size_nm": draw(st.none() | st.floats(1, 2000)),
            "gain_e_per_adu": draw(positive | text.filter(lambda t: not _is_number(t))),
            "well_depth_e": draw(st.none() | positive),
        },
        "particle": {
            "permittivity": draw(st.none() | st.tuples(finite, finite)),
            "mass_kda": draw(st.none() | positive),
        },
        "background": {"frames": draw(st.none() | st.just(frames))},
        "fit": {"mode": draw(st.sampled_from(DIPOLE_MODES)), "frames": frames},
        "posterior": {"enabled": draw(st.booleans() | st.just("auto"))},
        "calibration": draw(
            st.none()
            | st.fixed_dictionaries({"gradient_per_kda": st.floats(-0.01, -1e-7), "offset": finite})
        ),
        "simulation": {"shape": [rows, columns], "events": events},
    }
    return parse_config(values)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


@given(configurations(), st.booleans())
def test_toml_reads_back_to_an_equal_configuration(config: Config, comments: bool) -> None:
    text = config_to_toml(config, comments=comments)
    assert parse_config(tomllib.loads(text)) == config


@pytest.mark.parametrize("mode", get_args(Mode))
def test_the_printed_configuration_is_complete_and_explained(mode: str) -> None:
    sphere = ["particle.model=mie"] if mode not in DIPOLE_MODES else []
    config = load_config(None, [f"fit.mode={mode}", *sphere])
    text = config_to_toml(config)
    assert parse_config(tomllib.loads(text)) == config
    for name, field in Config.model_fields.items():
        assert f"[{name}]" in text
        section = getattr(config, name) or next(
            a for a in get_args(field.annotation) if isinstance(a, type) and issubclass(a, Section)
        )
        model = section if isinstance(section, type) else type(section)
        for key, info in model.model_fields.items():
            assert info.description, f"{name}.{key} has no description"
            if key not in SIMULATED:
                (line,) = [
                    each
                    for each in text.split(f"[{name}]")[1].split("\n\n")[0].splitlines()
                    if each.removeprefix("# ").startswith(f"{key} =")
                ]
                assert line.endswith(f"# {info.description}")


def test_the_sample_configurations_are_one_per_mode(sample_configs: dict[str, Path]) -> None:
    for mode in ("mass", "localize", "joint", "size"):
        assert load_config(sample_configs[mode]).fit.mode == mode


# What a fit needs around a particle, and what keeps two from sharing a square.
EDGE_NM = 1400.0
APART_NM = 2500.0


@pytest.mark.parametrize("name", ["mass", "localize", "joint"])
def test_sample_particles_are_well_apart(name: str, sample_configs: dict[str, Path]) -> None:
    config = load_config(sample_configs[name])
    pixel, (rows, columns) = config.camera.pixel_size_nm, config.simulation.shape
    assert pixel is not None
    places = [(e.x_px * pixel, e.y_px * pixel) for e in config.simulation.events]
    assert len(places) == 8
    for number, (x, y) in enumerate(places):
        assert EDGE_NM < x < (columns - 1) * pixel - EDGE_NM
        assert EDGE_NM < y < (rows - 1) * pixel - EDGE_NM
        for other_x, other_y in places[:number]:
            assert ((x - other_x) ** 2 + (y - other_y) ** 2) ** 0.5 > APART_NM
