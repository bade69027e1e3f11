"""What the commands promise whatever the library does: exit statuses, streams, one-line errors.

The library is replaced by a stand-in here; test_cli_end_to_end.py runs the real one.
"""

from __future__ import annotations

import ast
import json
import os
import pty
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import numpy as np
import pandas as pd
import pytest
from report_factory import summary_of

from iscat_analysis.config import MODES, load_config
from iscat_analysis.config import Mode as ConfigMode
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.findings import KINDS, Finding, FindingKind, Severity
from iscat_analysis.records import EVENT_COLUMNS, Status
from iscat_cli import main, main_fit
from iscat_cli.app import COMMANDS
from iscat_cli.options import Mode

Library = Callable[..., Any]


def _row(event: int, status: str = "ok", flags: str = "") -> dict[str, Any]:
    row: dict[str, Any] = dict.fromkeys(EVENT_COLUMNS, 1.0)
    row |= {"event": event, "frame": 200, "x_nm": 3456.789, "sigma_x_nm": 1.234, "mass_kda": 480.4}
    row |= {"sigma_mass_kda": 11.8, "crb_mass_kda": 11.5, "qcrb_mass_kda": 5.1, "z_nm": 5.0}
    row |= {"sigma_z_nm": np.nan, "crb_z_nm": np.nan, "status": status, "flags": flags}
    return row


def _analysis(
    *rows: dict[str, Any],
    mode: str = "mass",
    mass_scale: str = "calibration",
    findings: tuple[Finding, ...] = (),
    summary: dict[str, Any] | None = None,
) -> SimpleNamespace:
    table = pd.DataFrame(list(rows), columns=list(EVENT_COLUMNS))
    more = {"count": np.int64(len(rows)), "mass_scale": mass_scale, **(summary or {})}
    summary = summary_of(table, mode, "iscat") | more
    about = {"table": table, "mode": mode, "mode_kind": MODES[mode], "tracks": None}
    return SimpleNamespace(scheme="iscat", summary=summary, findings=findings, **about)


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> Callable[[Library], None]:
    """Put a function in the place of `fit_stack`."""

    def install(fit_stack: Library) -> None:
        stand_in = SimpleNamespace(fit_stack=fit_stack)
        monkeypatch.setitem(sys.modules, "iscat_analysis.pipeline", stand_in)

    return install


def _returning(analysis: SimpleNamespace, calls: list[dict[str, Any]] | None = None) -> Library:
    def fit_stack(stack: Path, config: Any, **options: Any) -> SimpleNamespace:
        if calls is not None:
            calls.append({"stack": stack, "config": config, **options})
        options["notify"]("reading")
        options["progress"]("fit", 8, 8)
        return analysis

    return fit_stack


def _raising(error: BaseException) -> Library:
    def fit_stack(*_: Any, **__: Any) -> Any:
        raise error

    return fit_stack


# ---- the call --------------------------------------------------------------------------------


def test_options_reach_the_library_resolved(library, capsys, tmp_path) -> None:
    calls: list[dict[str, Any]] = []
    library(_returning(_analysis(_row(0)), calls))
    setup = tmp_path / "setup.toml"
    setup.write_text('[fit]\nmode = "joint"\n[compute]\nworkers = 7\n')
    options = "--mode mass --frames 200:400 --background 0:150 --workers 3 --no-posterior"
    options += f" --config {setup} --set optics.na=1.3 --set fit.mode=track --overwrite"
    assert main_fit(["data/movie.tif", *options.split()]) == 0
    (call,) = calls
    config = call["config"]
    assert call["stack"] == Path("data/movie.tif")
    assert call["out"] == Path("data/movie.iscat")
    assert call["overwrite"] is True
    assert call["figures"] is False
    assert call["command"] == f"iscat-fit data/movie.tif {options}"
    assert config.fit.mode == "mass"
    assert config.fit.frames == (200, 400)
    assert config.background.frames == (0, 150)
    assert config.compute.workers == 3
    assert config.posterior.enabled is False
    assert config.optics.na == 1.3
    assert capsys.readouterr().err.splitlines() == ["iscat-fit: reading", "iscat-fit: fit: 8 of 8"]


def test_without_options_the_configuration_decides(library) -> None:
    calls: list[dict[str, Any]] = []
    library(_returning(_analysis(), calls))
    assert main(["fit", "movie.mp", "--out", "elsewhere"]) == 0
    assert calls[0]["config"] == load_config()
    assert calls[0]["out"] == Path("elsewhere")
    assert calls[0]["overwrite"] is False
    assert calls[0]["command"] == "iscat fit movie.mp --out elsewhere"


def test_modes_are_those_of_the_configuration() -> None:
    assert get_args(Mode) == get_args(ConfigMode) == tuple(MODES)


# ---- results ---------------------------------------------------------------------------------


@pytest.fixture
def printed(library, capsys) -> Callable[..., Any]:
    """Give what is printed of an analysis with these rows."""

    def run(*rows: dict[str, Any], options: tuple[str, ...] = (), **about: Any) -> Any:
        library(_returning(_analysis(*rows, **about)))
        assert main_fit(["movie.tif", *options]) == 0
        return capsys.readouterr()

    return run


PAGE = "the page: movie.iscat/report.html"


def test_the_answer_is_first_and_rows_come_only_where_they_are_asked_for(printed) -> None:
    """Control: the same events, with and without `--events`."""
    rows = [_row(n) for n in range(300)]
    brief = printed(*rows).out.splitlines()
    assert brief == ["Median mass 480 kDa, middle half 480 to 480 kDa", "300 events: 300 ok.", PAGE]
    long = printed(*rows, options=("--events", "20")).out.splitlines()
    assert [long[0], *long[-2:]] == brief
    assert len(long) == 3 + 1 + 20 + 1
    assert long[-3] == "… and 280 more in movie.iscat/fits.csv"


def test_the_table_of_events_is_plain(printed) -> None:
    rows = _row(0), _row(1, "at_bound", "at_bound")
    captured = printed(*rows, options=("--events=9",))
    warned, heading, first, second, *last = captured.out.splitlines()
    assert warned.startswith("1 of 2 events are flagged")
    assert Status.AT_BOUND.advice.rstrip(".") in warned
    assert "\x1b" not in captured.out
    assert all(word in heading for word in ("event", "x ± σ", "CRB mass", "QCRB mass", "status"))
    for cell in ("3456.8 ± 1.2", "480 ± 12", "11.5", "5.1", "ok"):
        assert cell in first
    assert "at_bound" in second
    assert last == ["2 events: 1 ok, 1 at_bound.", PAGE]


def test_the_commonest_remark_has_its_remedy(printed) -> None:
    """A status hides no other: what is said beside it is counted too."""
    rows = [*(_row(n) for n in range(10)), _row(10, "poor_fit", "poor_fit;saturated")]
    totals = printed(*rows, _row(11, "saturated", "saturated")).out.splitlines()[-2]
    assert totals.startswith("12 events: 10 ok, 1 poor_fit, 1 saturated. 2 saturated: ")
    assert totals.endswith(Status.SATURATED.advice)


def test_what_is_remarked_on_side_lobes_is_not_counted_among_the_events(printed) -> None:
    lobe = _row(1, "sidelobe", "sidelobe;poor_fit")
    told = printed(_row(0, "poor_fit", "poor_fit"), lobe, options=("--events=9",)).out.splitlines()
    assert told[0].startswith("The only event is flagged")
    assert len(told) == 5  # with a heading and one row
    assert told[-2] == "1 event: 1 poor_fit; further rows, which are no events: 1 sidelobe."


def test_without_calibration_contrasts_are_printed(printed) -> None:
    """A contrast of −0.0149 for 480.4 kDa: the spread keeps its share, and no kDa is printed."""
    row = _row(0) | {"contrast": -0.0149}
    warned, answer, heading, first, *last = printed(
        row, mass_scale="absolute model", options=("--events=9",)
    ).out.splitlines()
    assert "iscat calibrate mass" in warned
    assert "contrast ± σ" in heading
    assert "kDa" not in heading
    assert "−0.01490 ± 0.00037" in first
    assert answer == "Contrast 0.0149"
    assert last == ["1 event: 1 ok.", PAGE]


def test_joint_shows_the_bounds_of_height_too(printed) -> None:
    out = printed(_row(0), mode="joint", options=("--events=9",)).out
    assert "CRB z [nm]  QCRB z [nm]  CRB mass [kDa]" in out


def test_species_are_a_table_in_place_of_a_median(printed) -> None:
    """Outliers are no species; on the scale of contrasts nothing is in kDa."""
    species = [
        {"mass_kda": m, "mass_se": 1.31, "mass_systematic": 1.4, "count": 9.0, "fraction": 0.4}
        | {"fraction_low": 0.25, "fraction_high": 0.55, "landing": 8, "leaving": 1}
        | {"outlier": m == 9.0}
        for m in (146.0, 9.0, 66.0)
    ]
    summary = {"distribution": {"species": species}, "landing": {}}
    heading, *rows, totals, page = printed(_row(0), _row(1), summary=summary).out.splitlines()
    names = "mass ± σ [kDa]", "± common [kDa]", "events", "share", "95 %", "landing", "leaving"
    assert all(name in heading for name in names)
    cells = [line.split("  ") for line in rows]
    cells = [[cell.strip() for cell in line if cell.strip()] for line in cells]
    assert cells == [
        ["66.0 ± 1.3", "1.4", "9", "40 %", "25 to 55 %", "8", "1"],
        ["146.0 ± 1.3", "1.4", "9", "40 %", "25 to 55 %", "8", "1"],
    ]
    assert (totals, page) == ("2 events: 2 ok.", PAGE)
    out = printed(_row(0), summary={**summary, "mass_scale": "absolute model"}).out
    assert "contrast ± σ" in out
    assert "[kDa]" not in out


def test_no_events_is_a_result(printed) -> None:
    nothing, page = printed(options=("--strict",)).out.splitlines()
    assert nothing.startswith("0 events. If particles can be seen by eye, look at the field image")
    assert page == PAGE


def test_json_is_one_object_without_nan(printed) -> None:
    out = printed(_row(0), _row(1), options=("--json",)).out
    result = json.loads(out, parse_constant=pytest.fail)
    assert result["count"] == 2
    assert result["out"] == "movie.iscat"
    assert list(result["events"][0]) == list(EVENT_COLUMNS)
    assert result["events"][0]["sigma_z_nm"] is None
    assert result["events"][1]["event"] == 1


def test_quiet_leaves_stderr_empty(printed) -> None:
    captured = printed(_row(0, "poor_fit", "poor_fit"), options=("--quiet",))
    assert captured.err == ""
    assert "poor_fit" in captured.out


# ---- exit statuses ---------------------------------------------------------------------------


def _understated(so: bool) -> dict[str, Any]:
    return {"repeats": {"understated": so, "message": "", "cause": ""}}


@pytest.mark.parametrize(
    ("rows", "summary", "status"),
    [
        ([_row(0)], {}, 0),
        ([_row(0), _row(1, "not_converged", "not_converged")], {}, 3),
        ([_row(0, "ok", "masked_pixels")], {}, 3),
        ([_row(0) | {"flags": np.nan}], {}, 0),
        ([_row(0)], _understated(True), 3),
        ([_row(0)], _understated(False), 0),
    ],
)
def test_strict_exits_with_3_where_something_is_flagged_or_sigma_understated(
    library, rows, summary, status
) -> None:
    library(_returning(_analysis(*rows, summary=summary)))
    assert main_fit(["movie.tif", "--strict"]) == status
    assert main_fit(["movie.tif"]) == 0


def test_strict_with_codes_fails_on_these_findings_too(library, capsys, monkeypatch) -> None:
    """Control: the same finding passes where other codes are given, or none."""
    kinds = [FindingKind(f"test-{name}", Severity.NOTE, "{n} of them") for name in ("a", "b")]
    for kind in kinds:
        monkeypatch.setitem(KINDS, kind.code, kind)
    library(_returning(_analysis(_row(0), findings=(kinds[0]({"n": 3}),))))
    for codes, status in {"=test-a": 3, "=test-b,test-a": 3, "=test-b": 0, "": 0}.items():
        assert main_fit(["movie.tif", f"--strict{codes}"]) == status
    library(_returning(_analysis(_row(0, "poor_fit", "poor_fit"))))
    assert main_fit(["movie.tif", "--strict=test-b"]) == 3
    capsys.readouterr()
    library(_raising(RuntimeError("must not be reached")))
    assert main_fit(["movie.tif", "--strict=test-b,tset-a"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "--strict=tset-a: no finding has this code" in line
    assert all(code in line for code in KINDS)


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (DataError("m.tif: is empty: give a movie"), 1, "m.tif: is empty: give a movie"),
        (DataError("two\n  lines"), 1, "two; lines"),
        (ConfigError("fit.frames: outside"), 2, "fit.frames: outside"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (KeyboardInterrupt("3 events are in x"), 130, "interrupted: 3 events are in x"),
        (
            ZeroDivisionError("oh"),
            1,
            "unexpected ZeroDivisionError: oh; run again with --debug for the traceback",
        ),
        (MemoryError(), 1, "unexpected MemoryError; run again with --debug for the traceback"),
    ],
)
def test_errors_are_one_line_and_a_status(library, capsys, error, status, line) -> None:
    library(_raising(error))
    assert main_fit(["movie.tif"]) == status
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err == f"iscat-fit: error: {line}\n"


@pytest.mark.parametrize("error", [DataError("bad"), ZeroDivisionError("oh")])
def test_debug_shows_the_traceback(library, capsys, error) -> None:
    library(_raising(error))
    assert main_fit(["movie.tif", "--debug"]) == 1
    err = capsys.readouterr().err
    assert err.startswith("Traceback")
    assert "--debug" not in err.splitlines()[-1]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["fit"], "Missing argument 'STACK'"),
        (["fit", "m.tif", "--mdoe", "mass"], "--mode"),
        (["fit", "m.tif", "--overwite"], "--overwrite"),
        (["fit", "m.tif", "--mode", "mas"], "'mass', 'localize', 'joint', 'size', 'track'"),
        (["fit", "m.tif", "--mode", "mas"], "did you mean 'mass'?"),
        (["fit", "m.tif", "--workers", "0"], "--workers"),
        (["fit", "m.tif", "--workers", "two"], "--workers"),
        (["fit", "m.tif", "--frames", "-3:9"], "--frames -3:9: write it as A:B"),
        (["fit", "m.tif", "--background", "0-200"], "as in --background 0:200"),
        (["fit", "m.tif", "--set", "optics.na"], "section.key=value, as in optics.na=1.42"),
        (["fit", "m.tif", "--set", "optics.wavelength=525"], "did you mean wavelength_nm?"),
        (["fit", "m.tif", "--set", "optics.wavelength_nm=525nm"], "optics.wavelength_nm"),
        (["fit", "m.tif", "--config", "absent.toml"], "absent.toml: cannot be read"),
        (["fti", "m.tif"], "'fit'"),
        (["simulate", "--out", "m.tif"], "Missing option '--config'"),
        (["simulate", "--config", "c.toml"], "Missing option '--out'"),
        (["config", "--mode", "all"], "'mass'"),
        (["config", "extra"], "extra"),
    ],
)
def test_usage_errors_are_one_line_and_status_2(library, capsys, arguments, expected) -> None:
    library(_raising(RuntimeError("must not be reached")))
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    (line,) = captured.err.splitlines()
    assert line.startswith("iscat")
    assert ": error: " in line
    assert expected in line


def test_warnings_are_notes_and_quiet_drops_them(library, capsys) -> None:
    analysis = _analysis(_row(0))

    def fit_stack(*_: Any, **__: Any) -> SimpleNamespace:
        with warnings.catch_warnings():
            warnings.simplefilter("always")
            warnings.warn("doubtful", RuntimeWarning, stacklevel=1)
        return analysis

    library(fit_stack)
    assert main_fit(["movie.tif"]) == 0
    assert capsys.readouterr().err == "iscat-fit: warning: doubtful\n"
    main_fit(["movie.tif", "--quiet"])
    assert capsys.readouterr().err == ""


# ---- the other commands ----------------------------------------------------------------------


def test_simulate_makes_one_call(monkeypatch, capsys, tmp_path) -> None:
    calls: list[Any] = []

    def write_stack(config: Any, path: Path, **options: Any) -> pd.DataFrame:
        calls.append((config, path, options))
        row = dict.fromkeys(("x_px", "y_px", "x_nm", "y_nm", "z_nm", "mass_kda"), 1.5)
        row |= {"event": 0, "frame": 3, "leave": None, "contrast": np.nan}
        return pd.DataFrame([row, row | {"event": 1}])

    stand_in = SimpleNamespace(write_stack=write_stack)
    monkeypatch.setitem(sys.modules, "iscat_analysis.study.simulate", stand_in)
    setup = tmp_path / "setup.toml"
    setup.write_text("[simulation]\nframes = 10\n")
    arguments = ["simulate", "--config", str(setup), "--out", "m.tif", "--seed", "5", "--quiet"]
    assert main([*arguments, "--set", "simulation.frames=12"]) == 0
    (config, path, options) = calls[0]
    assert config.simulation.frames == 12
    assert path == Path("m.tif")
    assert options["seed"] == 5
    assert options["overwrite"] is False
    assert "2 particles in m.tif, truth in m.truth.csv" in capsys.readouterr().out
    main([*arguments, "--json"])
    first, second = json.loads(capsys.readouterr().out)["events"]
    assert first["x_px"] == 1.5
    assert second["contrast"] is None


@pytest.mark.parametrize(("mode", "more"), [("joint", []), ("size", ["particle.model=mie"])])
def test_config_prints_a_file_that_reads_back(mode: str, more: list[str], capsys, tmp_path) -> None:
    assert main(["config", "--mode", mode]) == 0
    path = tmp_path / "setup.toml"
    path.write_text(capsys.readouterr().out)
    assert load_config(path) == load_config(None, [f"fit.mode={mode}", *more])


# ---- help ------------------------------------------------------------------------------------


COMMAND_NAMES = [command.name for command in COMMANDS]


@pytest.mark.parametrize("command", [[], *([name] for name in COMMAND_NAMES)])
def test_help_fits_80_columns_and_ends_with_an_example(
    command: list[str], capsys, monkeypatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert main([*command, "--help"]) == 0
    out = capsys.readouterr().out
    assert [line for line in out.splitlines() if len(line) > 80] == []
    assert "..." not in out.partition("\n")[2]
    if command:
        assert f"\n      iscat {command[0]}" in out.partition("Example: ")[2]


def test_iscat_fit_calls_itself_by_its_name(capsys) -> None:
    assert main_fit(["--help"]) == 0
    out = capsys.readouterr().out
    assert "\n      iscat-fit movie.tif" in out
    assert "iscat fit" not in out


def test_without_a_command_there_is_help(capsys) -> None:
    assert main([]) == 0
    out = capsys.readouterr().out
    assert all(command in out for command in COMMAND_NAMES)
    assert "--install-completion" in out


def test_version(capsys) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("iscat-analysis ")


def test_help_imports_nothing_of_the_library() -> None:
    code = (
        "import sys; from iscat_cli import main; main(['fit', '--help']); "
        "print([m for m in sys.modules if m.split('.')[0] in "
        "('iscat_analysis', 'numpy', 'pandas', 'numba')], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    declared = {"iscat_analysis", "iscat_analysis.options"}  # which import nothing themselves
    assert set(ast.literal_eval(done.stderr)) <= declared


# ---- pipes and terminals ---------------------------------------------------------------------


def _python(code: str, **options: Any) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", code], **options)


COMMAND_LINES = [[], ["--version"], ["calibrate", "mass", "-h"], ["config"]]
"""One of every kind; the others of a kind are told the same way."""

SIMILAR = [
    ["--help"], ["fit", "--help"], ["simulate", "-h"], ["bounds", "-h"], ["benchmark", "-h"],
    ["calibrate"], ["calibrate", "camera", "-h"], ["config", "-h"],
]  # fmt: skip


@pytest.mark.parametrize(
    "arguments",
    [*COMMAND_LINES, *(pytest.param(line, marks=pytest.mark.large) for line in SIMILAR)],
    ids=" ".join,
)
def test_a_full_device_is_one_line_and_a_reader_that_leaves_none(arguments: list[str]) -> None:
    code = f"import sys, iscat_cli; sys.exit(iscat_cli.main({arguments}))"
    with Path("/dev/full").open("wb") as full:
        process = _python(code, stdout=full, stderr=subprocess.PIPE)
        _, err = process.communicate(timeout=60)
    (line,) = err.decode().splitlines()
    assert process.returncode == 1
    assert "error: " in line
    assert "printed (No space left on device)" in line

    reading, writing = os.pipe()
    os.close(reading)
    process = _python(code, stdout=writing, stderr=subprocess.PIPE)
    os.close(writing)
    _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (0, b"")


def test_a_terminal_that_knows_only_ascii_is_served() -> None:
    code = "import sys, iscat_cli; sys.exit(iscat_cli.main(['bounds', '--help']))"
    environment = os.environ | {"PYTHONIOENCODING": "ascii"}
    process = _python(code, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment)
    _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (0, b"")


PROGRESS = """
import sys
from types import SimpleNamespace
import pandas as pd
from iscat_analysis.records import EVENT_COLUMNS
from iscat_cli import main_fit
def fit_stack(stack, config, *, progress, notify, **_):
    for done in range(4):
        progress("fitting", done, 3)
    notify("half way")
    table = pd.DataFrame([], columns=list(EVENT_COLUMNS))
    return SimpleNamespace(table=table, mode="mass", summary={}, tracks=None)
sys.modules["iscat_analysis.pipeline"] = SimpleNamespace(fit_stack=fit_stack)
sys.exit(main_fit(sys.argv[1:]))
"""


@pytest.mark.parametrize("quiet", [False, True])
def test_bars_are_drawn_on_a_terminal_only(quiet: bool) -> None:
    arguments = [sys.executable, "-c", PROGRESS, "movie.tif", *(["--quiet"] if quiet else [])]
    environment = os.environ | {"TERM": "xterm"}
    master, terminal = pty.openpty()
    with subprocess.Popen(
        arguments, stdout=subprocess.PIPE, stderr=terminal, env=environment
    ) as process:
        os.close(terminal)
        drawn = b""
        while True:
            try:
                piece = os.read(master, 4096)
            except OSError:  # Linux's way of saying that the other end is closed
                break
            if not piece:
                break
            drawn += piece
        assert process.stdout is not None
        out = process.stdout.read()
    os.close(master)
    assert process.returncode == 0
    assert out.startswith(b"0 events. If particles can be seen by eye")
    assert (b"fitting" in drawn and b"half way" in drawn) is not quiet
    assert (b"\x1b[" in drawn) is not quiet


INTERRUPTED_IMPORT = """
import os, signal, sys
class Finder:
    def find_spec(self, name, *_):
        if name == sys.argv[1]:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Finder())
import iscat_cli
sys.exit(iscat_cli.main(["bounds", "--set", "camera.pixel_size_nm=80"]))
"""


@pytest.mark.parametrize(
    "module",
    [
        "typer",
        "numpy",
        *(pytest.param(n, marks=pytest.mark.large) for n in ("rich.console", "pydantic", "scipy")),
    ],
)
def test_an_interrupt_during_imports_is_quiet_and_130(module: str) -> None:
    arguments = [sys.executable, "-c", INTERRUPTED_IMPORT, module]
    done = subprocess.run(arguments, capture_output=True, check=False)
    assert (done.returncode, done.stdout) == (130, b"")
    assert done.stderr in (b"", b"iscat bounds: error: interrupted\n")
