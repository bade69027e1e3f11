"""One way to a configuration: the same keys give the same configuration, however they came."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import iscat_analysis as ia
from iscat_analysis.config import (
    BackgroundConfig,
    Config,
    Fit,
    config_to_toml,
    configure,
    load_config,
    parse_config,
    read_optics_file,
)
from iscat_analysis.errors import ConfigError
from iscat_analysis.fitting.context import make_context
from iscat_analysis.fitting.events import photons_scale
from iscat_analysis.fitting.ranges import background_mode

SETTINGS: list[tuple[str, Any]] = [
    ("optics.na", 1.3),
    ("optics.scheme", "cobri"),
    ("optics.scheme", "darkfield"),
    ("particle.mass_kda", 66.0),
    ("particle.diameter_nm", 20.0),
    ("particle.index", 1.5),
    ("particle.permittivity", (2.1, 0.0)),
    ("background.frames", (0, 50)),
    ("background.frames", "all"),
    ("background.method", "sliding"),
    ("background.method", "median"),
    ("fit.mode", "track"),
    ("fit.mode", "joint"),
    ("posterior.enabled", True),
    ("posterior.enabled", False),
    ("simulation.count", 3),
]


def _as_text(name: str, value: Any) -> str:
    if isinstance(value, tuple):
        return f"{name}={list(value)}"
    return f"{name}={str(value).lower()}"


def _outcome(make: Any) -> Config | str:
    try:
        return make()
    except ConfigError as error:
        return str(error).partition(": ")[2]


@pytest.mark.filterwarnings("ignore:background.method = .median. without:FutureWarning")
@given(st.lists(st.sampled_from(SETTINGS), max_size=5, unique_by=lambda pair: pair[0]))
def test_every_way_of_changing_keys_gives_the_same(chosen: list[tuple[str, Any]]) -> None:
    source = {"particle": {"mass_kda": 480.0, "permittivity": [2.0, 0.0]}}
    as_text = _outcome(lambda: configure(source, settings=[_as_text(*each) for each in chosen]))
    as_mapping = _outcome(lambda: configure(source, settings=dict(chosen)))
    one_by_one = _outcome(lambda: _one_by_one(source, chosen))
    assert as_text == as_mapping
    # A step on the way may be impossible, and what contradicts itself at once is refused.
    if isinstance(one_by_one, Config) and isinstance(as_mapping, Config):
        assert one_by_one == as_mapping


def _one_by_one(source: dict[str, Any], chosen: list[tuple[str, Any]]) -> Config:
    config = configure(source)
    for name, value in chosen:
        config = configure(config, settings={name: value})
    return config


def test_a_file_a_mapping_and_keywords_are_the_same(tmp_path: Path) -> None:
    path = tmp_path / "setup.toml"
    path.write_text("[optics]\nna = 1.3\n[particle]\ndiameter_nm = 20.0\n")
    nested = {"optics": {"na": 1.3}, "particle": {"diameter_nm": 20.0}}
    flat = {"optics.na": 1.3, "particle.diameter_nm": 20.0}
    same = [load_config(path), ia.configure(str(path)), configure(nested), configure(flat)]
    same += [configure(settings=nested), configure(settings=flat)]
    same += [load_config(None, ["optics.na=1.3", "particle.diameter_nm=20"])]
    assert all(config == same[0] for config in same)


@pytest.mark.parametrize(
    ("first", "second"),
    [("mass_kda", "diameter_nm"), ("index", "permittivity"), ("permittivity", "index")],
)
def test_the_later_of_two_that_exclude_each_other_wins(first: str, second: str) -> None:
    values = {"mass_kda": 480.0, "diameter_nm": 20.0, "index": 1.5, "permittivity": (2.1, 0.0)}
    for config in (
        configure({"particle": {first: values[first]}}, settings={f"particle.{second}": 3.0}
                  if second != "permittivity" else {"particle.permittivity": (3.0, 0.0)}),
        configure(configure(settings={f"particle.{first}": values[first]}),
                  settings={f"particle.{second}": values[second]}),
    ):  # fmt: skip
        assert getattr(config.particle, first) is None
        assert getattr(config.particle, second) is not None


def test_a_key_of_a_table_is_changed_alone() -> None:
    config = configure(settings=["optics.aberrations_nm.z5=3", "optics.aberrations_nm.z11=12.5"])
    assert config.optics.aberrations_nm == {"z5": 3.0, "z11": 12.5}
    fewer = configure(config, settings={"optics.aberrations_nm.z5": None})
    assert fewer.optics.aberrations_nm == {"z11": 12.5}
    with pytest.raises(ConfigError, match=r"optics\.aberrations_nm: zz is not on offer"):
        configure(settings=["optics.aberrations_nm.zz=1"])


def test_count_and_events_replace_each_other() -> None:
    event = {"frame": 5, "x_px": 10.0, "y_px": 10.0}
    config = configure({"simulation": {"events": [event]}}, settings=["simulation.count=0"])
    assert config.simulation.count == 0
    assert config.simulation.events == ()


def test_equal_configurations_sample_equally() -> None:
    """What was given explicitly and what was left at the same value are no longer told apart."""
    plain = configure()
    rebuilt = configure(plain, settings={"optics.na": plain.optics.na})
    assert plain == rebuilt
    assert plain.samples_posterior is rebuilt.samples_posterior is False
    assert configure(settings=["posterior.enabled=true"]).samples_posterior
    assert configure(settings=["background.frames=[0, 9]"]).samples_posterior
    assert not configure(settings=["fit.mode=track", "posterior.enabled=true"]).samples_posterior


def test_nothing_asks_which_keys_were_given() -> None:
    package = Path(ia.__file__).parent
    users = [p for p in package.rglob("*.py") if "model_fields_set" in p.read_text("utf-8")]
    assert not users


# ---- the background's method -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "method"),
    [
        ([], "sliding"),
        (["background.frames=[0, 100]"], "fixed"),
        (["optics.scheme=cobri"], "sliding"),
        (["optics.scheme=darkfield"], "fixed"),
        (["fit.mode=track"], "tracks"),
        (["background.method=median"], "median"),
        (["background.method=known", "background.level_e=2"], "known"),
    ],
)
def test_the_method_is_explicit_after_resolution(settings: list[str], method: str) -> None:
    config = configure(settings=settings)
    assert config.background.method == method
    assert f'method = "{method}"' in config_to_toml(config, comments=False)
    assert (background_mode(config) == "sliding") is (method == "sliding")


def test_the_method_follows_frames_that_are_added_or_taken_away() -> None:
    fixed = configure(configure(), settings={"background.frames": (0, 9)})
    assert fixed.background.method == "fixed"
    assert configure(fixed, settings={"background.frames": None}) == configure()
    assert configure(fixed, settings={"background.method": "sliding"}) == configure()


def test_old_values_work_with_a_line_that_names_the_new_ones() -> None:
    with pytest.warns(FutureWarning, match=r'background.method = "mean" is now called "fixed"'):
        config = configure({"background": {"method": "mean", "frames": [0, 9]}})
    assert config.background.method == "fixed"
    with pytest.warns(FutureWarning, match='"sliding"'):
        assert configure(settings=["background.method=mean"]).background.method == "sliding"
    with pytest.warns(FutureWarning, match='"known"'):
        known = configure(settings=["background.method=none", "background.level_e=3"])
    assert known.background.method == "known"


# ---- the median of all frames ----------------------------------------------------------------

TRACKED = {"fit": {"mode": "track"}}


def test_a_median_of_all_frames_is_asked_for_by_name() -> None:
    config = configure({**TRACKED, "background": {"frames": "all"}})
    assert (config.background.method, config.background.frames) == ("median", "all")
    assert config.background.recorded is None
    again = parse_config(tomllib.loads(config_to_toml(config)))
    assert again == config
    assert configure(again, settings={"background.method": "tracks"}) == configure(TRACKED)
    assert configure(configure(TRACKED), settings={"background.frames": "all"}) == config


def test_a_mean_of_all_frames_is_asked_for_by_both_names() -> None:
    """And remains one where the mode, or anything else, is named again."""
    config = configure({**TRACKED, "background": {"method": "fixed", "frames": "all"}})
    assert (config.background.method, config.background.frames) == ("fixed", "all")
    assert parse_config(tomllib.loads(config_to_toml(config))) == config
    assert configure(config, settings={"fit.mode": "track"}) == config
    assert configure(config, settings={"background.method": "tracks"}) == configure(TRACKED)


def test_a_median_without_frames_means_all_for_one_release_more() -> None:
    old = {**TRACKED, "background": {"method": "median"}}
    with pytest.warns(FutureWarning, match=r'without background.frames.*frames = "all"'):
        assert configure(old).background.frames == "all"
    with pytest.raises(ConfigError, match=r"of which frames\?.*\[0, 200\].*\"all\""):
        Config(fit=Fit(mode="track"), background=BackgroundConfig(method="median"))


@pytest.mark.parametrize(
    ("sections", "words"),
    [
        ({"background": {"frames": "all"}}, 'fit.mode = "mass"'),
        ({**TRACKED, "background": {"frames": "all"}, "optics": {"scheme": "darkfield"}}, "dark"),
        (
            {**TRACKED, "background": {"frames": "all", "method": "known", "level_e": 1e4}},
            'for method = "median" or "fixed"',
        ),
        ({**TRACKED, "background": {"frames": "every"}}, "[start, stop)"),
        ({**TRACKED, "background": {"frames": [3, 2]}}, "0 <= start < stop"),
        ({**TRACKED, "background": {"frames": [0, "x"]}}, "background.frames"),
    ],
)
def test_all_frames_are_no_background_elsewhere(sections: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(words)):
        configure(sections)


# ---- files -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[optics]\nna = 1,42\n", "line 2: numbers have a decimal point: write na = 1.42"),
        (
            "[optics]\nna = 1.4\n[fit]\n[optics]\nna = 1.3\n",
            r"line 4: the section [optics] is there twice",
        ),
        ("[optics]\nna = 1.4\nna = 1.3\n", "the key na is given twice"),
        ("[optics]\nna = 1.4\nna = 1.3\n\n[fit]\n", "the key na is given twice"),
        ("[optics\n", "not valid TOML"),
    ],
)
def test_slips_in_a_file_are_explained(text: str, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "setup.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=re.escape(expected)):
        load_config(path)


@pytest.mark.parametrize("written", ["COBRI", "Cobri", "cobri"])
def test_a_scheme_may_be_written_in_any_case(written: str) -> None:
    assert configure(settings=[f"optics.scheme={written}"]).optics.scheme == "cobri"


@pytest.mark.parametrize("source", [200, (1, 2), b"setup.toml"])
def test_what_is_no_configuration_is_refused(source: Any) -> None:
    with pytest.raises(ConfigError, match="made from a file, a mapping or a Config"):
        configure(source)


OPTICS = """[optics]
na = 1.401
focus_nm = -370.0
[uncertainty]
na = 0.0004
focus_nm = 2.2
[covariance]
names = ["na", "focus_nm"]
matrix = [[1.6e-7, 0.0], [0.0, 4.84]]
"""


@pytest.fixture
def setup(tmp_path: Path) -> Path:
    (tmp_path / "optics.toml").write_text(OPTICS)
    path = tmp_path / "setup.toml"
    path.write_text('[optics]\nfile = "optics.toml"\nna = 1.42\nattenuation = 0.5\n')
    return path


def test_an_optics_file_wins_over_the_section(setup: Path) -> None:
    config = load_config(setup)
    assert config.optics.na == 1.401
    assert config.optics.focus_nm == -370.0
    assert config.optics.attenuation == 0.5
    assert config.optics.file is not None
    measured = read_optics_file(Path(config.optics.file))
    assert measured["uncertainty"] == {"na": 0.0004, "focus_nm": 2.2}
    assert measured["covariance"]["matrix"][1][1] == 4.84


def test_an_optics_file_survives_the_way_through_a_resolved_file(setup: Path) -> None:
    config = load_config(setup)
    again = setup.with_name("config.toml")
    again.write_text(config_to_toml(config))
    assert load_config(again) == config


def test_a_change_that_contradicts_the_optics_file_is_refused(setup: Path) -> None:
    with pytest.raises(ConfigError, match=r"optics\.na = 1\.3 contradicts"):
        load_config(setup, ["optics.na=1.3"])
    assert configure(load_config(setup), settings={"optics.attenuation": 0.3}).optics.na == 1.401


def test_an_optics_file_without_optics_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "optics.toml"
    path.write_text("[camera]\npixel_size_nm = 84.4\n")
    with pytest.raises(ConfigError, match=r"has no table \[optics\]"):
        configure(settings={"optics.file": str(path)})


# ---- the simulation and the analysis ---------------------------------------------------------


def test_the_simulation_says_nothing_of_dark_field_masses() -> None:
    dark = {
        "optics": {"scheme": "darkfield"},
        "camera": {"pixel_size_nm": 84.4},
        "particle": {"photons_per_frame": 2000.0},
        "background": {"frames": [0, 10]},
    }
    scales = []
    for photons in (1e3, 1e5):
        config = configure(dark, settings={"simulation.photons_per_pixel": photons})
        context = make_context(config, (48, 48))
        windows = SimpleNamespace(power_ratio=1.0, n_before=10)
        scales.append(photons_scale(context, windows))  # type: ignore[arg-type]
    assert scales[0] == scales[1] > 0
    bare = make_context(configure(dark, settings={"particle.photons_per_frame": None}), (48, 48))
    with pytest.raises(ConfigError, match=r"particle\.photons_per_frame is needed"):
        photons_scale(bare, windows)  # type: ignore[arg-type]


def test_only_the_simulator_reads_the_simulation() -> None:
    package = Path(ia.__file__).parent
    readers = {
        str(path.relative_to(package))
        for path in package.rglob("*.py")
        if re.search(r"\.simulation\b(?! import)", path.read_text("utf-8"))
        and path.parent.name != "config"
    }
    assert readers <= {
        "study/simulate.py",
        "study/movers.py",
        "study/particles.py",
        "study/challenge.py",
        "study/challenge_presets.py",
        "study/challenge_scores.py",
    }


def test_a_blank_is_a_movie_without_particles(tmp_path: Path) -> None:
    blank = {"simulation": {"count": 0, "shape": [16, 16], "frames": 4}}
    setup = configure(blank, settings={"camera.pixel_size_nm": 84.4})
    truth = ia.simulate_movie(setup, tmp_path / "blank.tif")
    assert truth.empty
    assert (tmp_path / "blank.truth.csv").read_text().startswith("event,frame")


def test_keys_of_later_files_win_and_a_mass_line_is_one(tmp_path: Path) -> None:
    """Nothing of the first file is dropped but what the second says too."""
    first, second = tmp_path / "first.toml", tmp_path / "second.toml"
    first.write_text(
        "[optics]\nna = 1.3\nfocus_nm = 120.0\n[particle]\nmass_kda = 66.0\n"
        "[calibration]\ngradient_per_kda = -3e-5\noffset = 1e-4\n"
    )
    second.write_text(
        "[optics]\nna = 1.42\n[particle]\ndiameter_nm = 20.0\n"
        "[calibration]\ngradient_per_kda = -4e-5\n"
    )
    both = load_config([first, second], ["optics.wavelength_nm=500"])
    assert (both.optics.na, both.optics.focus_nm, both.optics.wavelength_nm) == (1.42, 120.0, 500)
    assert (both.particle.mass_kda, both.particle.diameter_nm) == (None, 20.0)
    assert both.calibration is not None
    assert (both.calibration.gradient_per_kda, both.calibration.offset) == (-4e-5, 0.0)
    assert load_config([second, first]).optics.na == 1.3
    assert configure([first]) == load_config(first)
    assert configure([]) == configure()
    second.write_text("[optics]\nnaa = 1.42\n")
    with pytest.raises(ConfigError, match=r"first\.toml, .*second\.toml: unknown key optics\.naa"):
        load_config([first, second])
