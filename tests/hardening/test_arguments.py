"""Any configuration and any command line: one line of error at most, and a known exit status."""

from __future__ import annotations

import contextlib
import io
import math
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from iscat_analysis import config as config_module
from iscat_analysis.config import Config, config_to_toml, known_keys, load_config, parse_config
from iscat_analysis.errors import ConfigError, IscatError
from iscat_cli import main, main_fit
from iscat_cli.app import COMMANDS

STATUSES = {0, 1, 2, 3, 130}
SECTIONS = list(Config.model_fields)
KEYS = sorted({key for name in SECTIONS for key in known_keys([name])})
NUMBERS = st.one_of(
    st.integers(),
    st.floats(),
    st.sampled_from([0, -1, 1, 2, 1e-300, 1e300, 2**63, -(2**63), 10**400]),
)
WORDS = st.one_of(st.text(max_size=12), st.sampled_from(["flat", "iscat", "mass", "nan", "\0", ""]))
VALUES: st.SearchStrategy[Any] = st.recursive(
    st.one_of(NUMBERS, WORDS, st.booleans(), st.none(), st.dates(), st.binary(max_size=4)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=4),
        st.dictionaries(st.sampled_from(KEYS) | WORDS, inner, max_size=4),
    ),
    max_leaves=6,
)
TABLES = st.dictionaries(
    st.sampled_from(SECTIONS) | WORDS,
    st.dictionaries(st.sampled_from(KEYS) | WORDS, VALUES, max_size=4) | VALUES,
    max_size=4,
)


@settings(max_examples=150)
@given(values=TABLES)
@example(values={"str": {}})
@example(values={"optics": {"float": 1}})
def test_any_mapping_is_a_configuration_or_refused(values: dict[str, Any]) -> None:
    with contextlib.suppress(ConfigError):
        found = parse_config(values)
        assert parse_config(found.model_dump()) == found


PIECES = [
    "[optics]", "[camera", "na = 1.3", "pixel_size_nm = ", "nan", "-inf", "[[simulation.events]]",
    "frame = 3", "\n", "=", "'", '"""', "{", "}", "[" * 300, "a." * 300, "1e999", "0x", "#", ",",
]  # fmt: skip
TEXTS = st.text(max_size=200) | st.lists(st.sampled_from(PIECES), max_size=14).map("\n".join)


@settings(max_examples=150)
@given(raw=st.binary(max_size=100) | TEXTS.map(lambda t: t.encode("utf-8", "surrogatepass")))
def test_any_content_is_a_configuration_or_refused(raw: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "setup.toml"
        path.write_bytes(raw)
        with contextlib.suppress(ConfigError):
            load_config(path)


@settings(max_examples=120)
@given(
    overrides=st.lists(
        st.text(max_size=20)
        | st.builds(
            lambda section, key, value: f"{section}.{key}={value}",
            st.sampled_from(SECTIONS),
            st.sampled_from(KEYS),
            st.text(max_size=12) | NUMBERS.map(str) | st.just("[" * 400),
        ),
        max_size=3,
    )
)
def test_any_override_is_applied_or_refused(overrides: list[str]) -> None:
    with contextlib.suppress(ConfigError):
        load_config(None, overrides)


@settings(max_examples=150)
@given(
    pixel=st.floats(1, 2000),
    focus=st.floats(-1e5, 1e5),
    mass=st.floats(1e-6, 1e9),
    name=st.text(
        st.characters(codec="utf-8", categories=["L", "N", "P", "S"], exclude_characters="/"),
        max_size=12,
    ),
    seed=st.integers(0, 2**63),
)
def test_what_is_written_is_read_back(
    pixel: float, focus: float, mass: float, name: str, seed: int
) -> None:
    found = parse_config(
        {
            "camera": {"pixel_size_nm": pixel, "gain_e_per_adu": f"/maps/{name}.tif"},
            "optics": {"focus_nm": focus},
            "particle": {"mass_kda": mass},
            "simulation": {"seed": seed},
        }
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "config.toml"
        path.write_text(config_to_toml(found), encoding="utf-8")
        again = load_config(path)
    assert again == found
    assert math.isfinite(again.optics.focus_nm)


# ---- command lines -------------------------------------------------------------------------------

OPTIONS = [
    "--help", "-h", "--version", "--json", "--quiet", "--debug", "--overwrite", "--strict",
    "--config", "--out", "--set", "--mode", "--frames", "--background", "--workers", "--seed",
    "--scan", "--preset", "--trials", "--standards", "--posterior", "--no-posterior", "--", "-",
    "--conf", "--=", "-x", "--mode=mass", "--mode=\0".replace("\0", "?"), "--frames=0:0",
]  # fmt: skip
ARGUMENTS = st.lists(
    st.one_of(
        st.sampled_from([command.name for command in COMMANDS]),
        st.sampled_from(OPTIONS),
        st.text(st.characters(exclude_characters="\0"), max_size=8),
        st.binary(max_size=4).map(lambda raw: os.fsdecode(raw.replace(b"\0", b""))),
        st.sampled_from(["0:10", "-1", "nan", "1e9", "mass", "absent.tif", ".", "..", "a=b"]),
    ),
    max_size=7,
)


@pytest.fixture
def nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Stand in an empty folder, and let every command end where its configuration is complete."""
    monkeypatch.chdir(tmp_path)
    real = config_module.load_config

    def enough(*arguments: Any) -> Any:
        real(*arguments)
        raise ConfigError("that would be enough to begin the work")

    def interrupt(_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(config_module, "load_config", enough)
    monkeypatch.setattr("iscat_analysis.day.watch.WatchedFolder.check", interrupt)
    monkeypatch.setattr("tornado.platform.asyncio.BaseAsyncIOLoop.start", interrupt)
    return tmp_path


def run(program: Any, arguments: list[str]) -> None:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = program(arguments)
    assert status in STATUSES
    if "--debug" not in arguments:
        assert "Traceback" not in err.getvalue()
        assert ": error: unexpected " not in err.getvalue()
    if status == 2 and "--debug" not in arguments:
        lines = [line for line in err.getvalue().splitlines() if line.strip()]
        assert len(lines) == 1, err.getvalue()


def test_watching_ends_nowhere(nowhere: Path) -> None:
    run(main, ["watch", "."])
    run(main, ["watch", "absent"])
    assert not list(nowhere.iterdir())


def test_any_command_line_ends_well(nowhere: Path, repetitions: Callable[[int, int], int]) -> None:
    before = set(nowhere.iterdir())

    @settings(max_examples=repetitions(40, 300))
    @given(arguments=ARGUMENTS)
    def umbrella(arguments: list[str]) -> None:
        run(main, arguments)

    @settings(max_examples=repetitions(20, 200))
    @given(arguments=ARGUMENTS)
    def fit(arguments: list[str]) -> None:
        run(main_fit, arguments)

    umbrella()
    fit()
    assert set(nowhere.iterdir()) == before


def test_errors_of_the_library_say_one_line() -> None:
    with pytest.raises(IscatError) as caught:
        load_config(None, ["optics.nas=1", "camera.pixel_size_nm=-1"])
    assert len(str(caught.value).strip().splitlines()) == 1


def test_a_name_that_no_file_can_have_is_refused() -> None:
    with pytest.raises(ConfigError, match="is no name of a file"):
        load_config(None, ["optics.file=\0"])
