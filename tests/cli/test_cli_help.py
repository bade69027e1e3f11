"""What help, completion and progress promise: every example runs, every shell is served."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tifffile
import typer
from event_tables import draw_series
from report_factory import make_analysis
from scenes import write_bright_landings
from small_movies import SMALL
from walkers import SETUP, fits_of, walk

from iscat_analysis.config import SIMULATED, Config, config_to_toml, load_config
from iscat_analysis.progress import duration
from iscat_analysis.records import EVENT_COLUMNS
from iscat_analysis.report import write_report
from iscat_analysis.species import describe_tracks
from iscat_cli import console, main, main_fit
from iscat_cli.app import COMMANDS, GROUPS, _umbrella
from iscat_cli.console import Messages
from iscat_contest.challenge import make_challenge, parts_of_config

PROGRAMS = {"iscat": main, "iscat-fit": main_fit}
SHELLS = ["bash", "zsh", "fish"]

NAMED = [((command.name,), command.example) for command in COMMANDS]
NAMED += [
    ((group, command.name), command.example)
    for group, _, commands in GROUPS
    for command in commands
]


def _examples() -> list[str]:
    return [
        line.strip()
        for _, example in NAMED
        for line in example.splitlines()
        if line.startswith("    iscat")
    ]


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory, sample_configs) -> Path:
    """Make a folder with the files that the examples name."""
    folder = tmp_path_factory.mktemp("laboratory")
    (folder / "sample_configs").mkdir()
    for name, path in sample_configs.items():
        shutil.copy(path, folder / "sample_configs" / f"{name}.toml")
    small = _small(folder / "sample_configs" / "mass.toml")
    (folder / "setup.toml").write_text(small, encoding="utf-8")
    random = np.random.default_rng(1)
    simulate = ["simulate", "--config", str(folder / "setup.toml"), "--quiet"]
    assert main([*simulate, "--out", str(folder / "kept.tif")]) == 0
    read = 4 * random.standard_normal((60, 64, 64))
    tifffile.imwrite(folder / "dark.tif", np.rint(100 + read).astype("uint16"))
    mass = random.normal(np.repeat([66.0, 146.0, 480.0], 60), 8.0)
    table = pd.DataFrame(0.0, index=range(mass.size), columns=list(EVENT_COLUMNS))
    table = table.assign(mass_kda=mass, sigma_mass_kda=8.0, contrast=-3.1e-5 * mass)
    (folder / "standards.iscat").mkdir()
    table.assign(status="ok", flags="").to_csv(folder / "standards.iscat/fits.csv", index=False)
    totals = np.array([[3.0], [30.0]])
    for number, one in enumerate(draw_series(random, "dimer", totals, 10.0, [66.0], number=200)):
        one.to_csv(folder / f"{number}.csv", index=False)
    rows = pd.DataFrame({"path": ["0.csv", "1.csv"], "concentration_nm": totals[:, 0]})
    rows.to_csv(folder / "series.csv", index=False)
    make_challenge(parts_of_config(load_config(folder / "setup.toml", ["fit.roi_nm=900"]), 12),
                   folder / "challenge", name="setup")  # fmt: skip
    events = json.loads((folder / "challenge/truth.json").read_text(encoding="utf-8"))["events"]
    truth = pd.DataFrame([one for one in events if one["part"] == "stack"])
    truth = truth[["event", "x_nm", "y_nm", "mass_kda"]]
    truth.to_csv(folder / "true.csv", index=False)
    noisy = truth.assign(x_nm=truth["x_nm"] + random.normal(0, 9.0, len(truth)))
    noisy.to_csv(folder / "results.csv", index=False)
    (folder / "moving.iscat").mkdir()
    fits = fits_of([walk(random, 30, 0.3)], random)
    fits.to_csv(folder / "moving.iscat/fits.csv", index=False)
    describe_tracks(fits, SETUP).to_csv(folder / "moving.iscat/tracks.csv", index=False)
    return folder


def _small(path: Path) -> str:
    return config_to_toml(load_config(path, SMALL))


def test_every_command_has_an_example() -> None:
    shown = _examples()
    for name, _ in NAMED:
        assert any(example.startswith(f"iscat {' '.join(name)} ") for example in shown)


def _interrupt(_: object) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("example", _examples())
def test_every_example_runs(
    example: str, laboratory: Path, tmp_path: Path, monkeypatch, capsys
) -> None:
    for source in laboratory.iterdir():
        (shutil.copytree if source.is_dir() else shutil.copy)(source, tmp_path / source.name)
    monkeypatch.chdir(tmp_path)
    program, *arguments = shlex.split(example)
    redirected: Path | None = None
    if ">" in arguments:
        arguments, redirected = arguments[:-2], Path(arguments[-1])
    monkeypatch.setattr("webbrowser.open", lambda _: True)
    if "view" in arguments:
        Path("movie.iscat").mkdir()
        Path("movie.iscat/report.html").write_text("<title>a page</title>", encoding="utf-8")
    if "figures" in arguments:
        write_report(make_analysis(3), Path("movie.iscat"))
    if "watch" in arguments:
        Path("movies").mkdir()
        monkeypatch.setattr("iscat_analysis.day.watch.WatchedFolder.check", _interrupt)
        monkeypatch.setattr("iscat_analysis.day.watch.RESTS", 0)
    if "app" in arguments:  # test_app goes the whole way, in a browser
        pytest.importorskip("panel", reason="needs the Python package panel")
        Path("measurements/monday").mkdir(parents=True)
        monkeypatch.setattr("tornado.platform.asyncio.BaseAsyncIOLoop.start", _interrupt)
    if "samples.csv" in arguments:
        Path("samples.csv").write_text("path,sample\nmovie.tif,protein\n", encoding="utf-8")
        Path("kept.tif").rename("movie.tif")
    if "movie.tif" in arguments and "simulate" not in arguments:
        Path("kept.tif").rename("movie.tif")
        arguments = [a.replace("0:200", "0:30") for a in arguments]
    if "landing.tif" in arguments:
        write_bright_landings(Path("landing.tif"), Path("landing.toml"))
        arguments += ["--free", "focus,phase"]
    if "simulate" in arguments:
        arguments += [f"--set={change}" for change in SMALL]
    if "--trials" in arguments:
        arguments += ["--no-posterior", "--set", "fit.roi_nm=900"]
        arguments[arguments.index("--trials") + 1] = "20"  # fewer; the shape stays the same
    if "species" in arguments:
        arguments += ["--draws", "3"]
    arguments = [a.replace(":1000:20", ":1000:200") for a in arguments]
    if "pupil" in arguments:  # test_pupil_search goes the whole way
        arguments += ["--free", "phase", "--set", "bounds.pixels=25"]
    capsys.readouterr()
    assert PROGRAMS[program](arguments) == 0
    out = capsys.readouterr().out
    assert out.strip()
    if redirected is not None:
        redirected.write_text(out, encoding="utf-8")
        load_config(redirected)


# ---- the configuration -----------------------------------------------------------------------


def test_the_configuration_is_complete_and_explained(capsys) -> None:
    assert main(["config"]) == 0
    out = capsys.readouterr().out
    for section, field in Config.model_fields.items():
        assert f"[{section}]" in out
        keys = _keys(field.annotation)
        assert keys
        block = out.split(f"[{section}]", 1)[1]
        for key, described in keys.items():
            if key in SIMULATED:
                assert f"[[simulation.{key}]]" in out
                for own in SIMULATED[key].model_fields:
                    assert f"\n# {own} = " in out.split(f"[[simulation.{key}]]", 1)[1]
                continue
            line = re.search(rf"^(?:# )?{key} = .*?# (.+)$|^# {key} = +# (.+)$", block, re.M)
            assert line is not None, f"{section}.{key}"
            assert described.description
    assert [line for line in out.splitlines() if len(line) > 80] == []


def _keys(annotation: object) -> dict:
    from typing import get_args

    for part in (annotation, *get_args(annotation)):
        if hasattr(part, "model_fields"):
            return part.model_fields
    return {}


def test_every_line_of_the_configuration_can_be_used(capsys, tmp_path) -> None:
    """Take the # away from a key without a value, fill it in, and the file is read."""
    main(["config"])
    text = capsys.readouterr().out
    for key, value in {"pixel_size_nm": "84.4", "mass_kda": "480.0", "level_e": "1e4"}.items():
        text, count = re.subn(rf"^# {key} = ", f"{key} = {value} ", text, count=1, flags=re.M)
        assert count == 1
    text = text.replace("# [[simulation.events]]", "[[simulation.events]] #")
    text = text.replace("# [[simulation.movers]]", "[[simulation.movers]] #")
    for key, value in {"frame": "3", "x_px": "20.0", "y_px": "20.0", "d_um2_s": "0.5"}.items():
        text, count = re.subn(rf"^# {key} = ", f"{key} = {value} ", text, count=1, flags=re.M)
        assert count == 1
    path = tmp_path / "setup.toml"
    path.write_text(text, encoding="utf-8")
    config = load_config(path)
    assert config.camera.pixel_size_nm == 84.4
    assert config.simulation.events[0].x_px == 20.0
    assert config.simulation.movers[0].d_um2_s == 0.5


# ---- completion ------------------------------------------------------------------------------


@pytest.fixture
def answer(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., str]:
    """Ask a program as a shell does, which sets variables; it prints, and ends without running."""

    def ask(program: str, instruction: str, **more: str) -> str:
        monkeypatch.setenv(f"_{program.upper().replace('-', '_')}_COMPLETE", instruction)
        for name, value in more.items():
            monkeypatch.setenv(name, value)
        with pytest.raises(SystemExit) as end:
            PROGRAMS[program]([])
        assert not end.value.code
        shown = capsys.readouterr()
        assert shown.err == ""
        return shown.out

    return ask


@pytest.fixture
def complete(answer: Callable[..., str]) -> Callable[..., str]:
    """Ask a program what may come next in a command line."""

    def ask(program: str, words: str, shell: str = "bash") -> str:
        return answer(
            program, f"complete_{shell}", COMP_WORDS=words, COMP_CWORD=str(words.count(" ")),
            _TYPER_COMPLETE_ARGS=words, _TYPER_COMPLETE_FISH_ACTION="get-args",
        )  # fmt: skip

    return ask


@pytest.mark.parametrize("shell", SHELLS)
@pytest.mark.parametrize("program", list(PROGRAMS))
def test_completion_scripts_are_written(
    program: str, shell: str, answer: Callable[..., str]
) -> None:
    name = program.upper().replace("-", "_")
    script = answer(program, f"source_{shell}")
    assert program in script
    assert f"_{name}_COMPLETE=complete_{shell}" in script
    if shutil.which(shell):
        options = ["--no-execute"] if shell == "fish" else ["-n"]
        subprocess.run([shell, *options], input=script, text=True, check=True)


@pytest.mark.parametrize("shell", SHELLS)
def test_the_shell_is_offered_commands(shell: str, complete: Callable[..., str]) -> None:
    offered = complete("iscat", "iscat si", shell)
    assert "simulate" in offered
    assert "bounds" not in offered


def test_the_shell_is_offered_options_modes_and_keys(complete: Callable[..., str]) -> None:
    assert "--background" in complete("iscat-fit", "iscat-fit movie.tif --ba").split()
    assert complete("iscat-fit", "iscat-fit movie.tif --mode jo").split() == ["joint"]
    assert "optics.na=" in complete("iscat", "iscat fit movie.tif --set optics.n").split()
    assert "calibration.offset=" in complete("iscat", "iscat fit --set calibration.o").split()


# ---- progress --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("seconds", "said"),
    [(0.2, "1 s"), (8, "8 s"), (99.5, "100 s"), (130, "3 min"), (7500, "2 h 5 min")],
)
def test_durations_are_said_as_people_do(seconds: float, said: str) -> None:
    assert duration(seconds) == said


@pytest.fixture
def clock(monkeypatch) -> Callable[[float], None]:
    """Put a clock that is set by hand in the place of time."""
    now = [100.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: now[0])

    def advance(seconds: float) -> None:
        now[0] += seconds

    return advance


def test_plain_progress_tells_the_time_left_and_is_no_flood(clock, capsys) -> None:
    with Messages("iscat-fit").progress() as progress:
        for done in range(1, 1001):
            clock(0.125)
            progress("fit", done, 1000)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "iscat-fit: fit: 16 of 1000, about 3 min left"
    assert lines[1] == "iscat-fit: fit: 96 of 1000, about 2 min left"
    assert lines[-1] == "iscat-fit: fit: 1000 of 1000"
    assert len(lines) == 14


def test_short_stages_say_one_line_each_and_repeat_nothing(clock, capsys) -> None:
    with Messages("iscat-fit").progress() as progress:
        for _ in range(50):
            for stage in ("detect", "detect"):
                clock(0.01)
                progress(stage, 1, 1)
    assert capsys.readouterr().err == "iscat-fit: detect: 1 of 1\n"


# ---- options that are given twice ----------------------------------------------------------------


def _commands() -> list[tuple[tuple[str, ...], typer.core.TyperCommand]]:
    umbrella = typer.main.get_command(_umbrella())
    found = []
    for words, _ in NAMED:
        command = umbrella
        for word in words:
            command = command.commands[word]
        found.append((words, command))
    return found


@pytest.mark.parametrize(("words", "command"), _commands(), ids=lambda each: str(each)[:20])
def test_what_is_given_twice_and_means_one_thing_is_refused(words, command, capsys) -> None:
    """Every option of every command, whatever it is; the others are lists."""
    for option in command.params:
        if option.param_type_name != "option" or option.is_eager:
            continue
        if option.multiple:
            assert option.opts[0] in ("--config", "--set", "--estimator"), words
            continue
        value = [] if option.is_flag else ["1"]
        again = (option.secondary_opts or option.opts)[0]
        assert main([*words, option.opts[0], *value, again, *value]) == 2
        error = capsys.readouterr().err
        assert f"{option.opts[0]} is given twice" in error
        assert len(error.splitlines()) == 1


def test_one_key_set_twice_and_files_that_are_merged(tmp_path: Path, capsys) -> None:
    for number, na in enumerate((1.2, 1.3)):
        (tmp_path / f"{number}.toml").write_text(f"[optics]\nna = {na}\n")
    files = [f"{tmp_path}/{number}.toml" for number in range(2)]
    more = ["--set", "camera.pixel_size_nm=84.4", "--set", "bounds.pixels=31", "--json"]
    bounds = ["bounds", "--config", files[0], *more]
    assert main([*bounds, "--set", "optics.na=1.3", "--set", "optics.na=1.4"]) == 2
    assert "--set optics.na is given twice" in capsys.readouterr().err
    assert main([*bounds, "--config", files[1]]) == 0
    printed = capsys.readouterr()
    assert f"the configuration is {files[0]}, with the keys of {files[1]}" in printed.err
    assert main(["bounds", "--config", files[1], *more]) == 0
    assert capsys.readouterr().out == printed.out
