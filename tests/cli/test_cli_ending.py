"""A request to end is answered within two seconds, wherever the program is."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import typer
from commands import within
from forks import fork

from iscat_analysis.errors import ConfigError
from iscat_cli import INTERRUPTED
from iscat_cli.console import Messages, failures

SECONDS = 2.0
LOADED = 3.0  # more, for a machine that does other things as well

BUSY = """
import hashlib, sys
from concurrent.futures import ThreadPoolExecutor
import typer
import iscat_cli
from iscat_cli import app
from iscat_cli.console import Messages, failures

def compiled():
    hashlib.pbkdf2_hmac("sha512", b"", b"", 200_000_000)  # minutes in C, without Python's lock

def in_a_thread():
    with ThreadPoolExecutor(1) as pool:
        pool.submit(compiled).result()

def run(program, arguments):
    try:
        with failures(Messages("iscat busy")):
            print("busy", flush=True)
            {where}()
    except typer.Exit as end:
        return end.exit_code
    return 0

app.run = run
sys.exit(iscat_cli.main())
"""


@pytest.mark.parametrize(
    ("where", "number"),
    [
        ("compiled", signal.SIGINT),
        ("in_a_thread", signal.SIGTERM),
        pytest.param("compiled", signal.SIGTERM, marks=pytest.mark.large),
        pytest.param("in_a_thread", signal.SIGINT, marks=pytest.mark.large),
    ],
)
def test_compiled_code_does_not_hold_the_program(where: str, number: signal.Signals) -> None:
    code = BUSY.replace("{where}", where)
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "busy\n"
        time.sleep(0.3)
        begun = time.monotonic()
        process.send_signal(number)
        _, err = process.communicate(timeout=SECONDS + LOADED)
        seconds = time.monotonic() - begun
    finally:
        process.kill()
    assert process.returncode == -signal.SIGINT
    assert "interrupted" in err
    assert len(err.splitlines()) == 1
    assert seconds < SECONDS + LOADED


def test_an_interrupt_that_meets_compiled_code_is_an_interrupt(capsys) -> None:
    """Numba turns an exception that a signal raises inside its dispatcher into a SystemError."""
    with pytest.raises(typer.Exit) as ended, failures(Messages("iscat fit")):
        raise SystemError("returned a result with an exception set") from KeyboardInterrupt()
    assert ended.value.exit_code == 130
    assert capsys.readouterr().err == "iscat fit: error: interrupted\n"


@pytest.mark.parametrize(
    ("said", "shown"),
    [
        (
            "`scan` = z: write it as `scan` = z=0:2000:50",
            "--scan z: write it as --scan z=0:2000:50",
        ),
        ("pass `overwrite`, or choose another `out`", "pass --overwrite, or choose another --out"),
        ("`standards_kda` = 66,66: names a mass twice", "--standards 66,66: names a mass twice"),
        ("give background.frames = [0, 200]", "give --background 0:200"),
        ('choose fit.mode = "joint"', "choose --mode joint"),
        (
            "set it, as in camera.gain_e_per_adu = 1.5",
            "set it, as in --set camera.gain_e_per_adu=1.5",
        ),
        ("use `conditional` or `a b`", "use `conditional` or `a b`"),
    ],
)
def test_commands_name_options_where_the_library_names_arguments(
    said: str, shown: str, capsys
) -> None:
    with pytest.raises(typer.Exit), failures(Messages("iscat fit")):
        raise ConfigError(said)
    assert capsys.readouterr().err == f"iscat fit: error: {shown}\n"


def test_impossible_lengths_end_at_once_and_small(tmp_path: Path) -> None:
    settings = {
        "optics.wavelength_nm=0.525": "write 525",
        "optics.wavelength_nm=5.25": "not between 200 and 3000 nm",
        "bounds.pixels=4096": "MB",
    }
    given = ["bounds", "--set", "camera.pixel_size_nm=84.4", "--set"]
    log = tmp_path / "err"
    commands = [[*given, each] for each in settings]
    process = fork(within, 6 * 2**30, commands, folder=tmp_path, err=log)
    process.join(120)
    assert process.exitcode == 2
    lines = log.read_text().splitlines()
    assert len(lines) == 3
    assert all(said in line for line, said in zip(lines, settings.values(), strict=True))


CALLBACK = """
import ctypes, os, signal, sys, time
import typer, iscat_cli
from iscat_cli import app
from iscat_cli.console import Messages, failures

@ctypes.CFUNCTYPE(None)
def callback():
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(1)

def run(program, arguments):
    try:
        with failures(Messages("iscat")):
            callback()
            {then}
    except typer.Exit as end:
        return end.exit_code
    return 0

app.run = run
sys.exit(iscat_cli.main())
"""


@pytest.mark.parametrize("then", ["time.sleep(60)", 'raise RuntimeError("no compiled object yet")'])
def test_an_interrupt_in_a_callback_of_compiled_code_is_one(then: str) -> None:
    """Python forgets it there; the compiler then misses what it had asked for."""
    code = CALLBACK.replace("{then}", then)
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=50, check=False
    )
    assert done.returncode == INTERRUPTED
    assert done.stderr == "iscat: error: interrupted\n"


def test_a_process_that_is_ended_reports_130_to_a_shell() -> None:
    """The control ends by another signal."""
    code = BUSY.replace("{where}", "compiled").replace(
        "hashlib.pbkdf2", "import os, signal; os.kill(os.getpid(), signal.{name}); hashlib.pbkdf2"
    )
    for name, status in (("SIGTERM", 130), ("SIGKILL", 137)):
        shell = ["sh", "-c", '"$0" -c "$1"; exit $?', sys.executable, code.replace("{name}", name)]
        assert subprocess.run(shell, capture_output=True, check=False).returncode == status


def test_signals_are_as_before_when_a_command_has_ended() -> None:
    def state() -> list[object]:
        numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)
        return [*map(signal.getsignal, numbers), signal.pthread_sigmask(signal.SIG_BLOCK, ())]

    before = state()
    with failures(Messages("iscat")):
        pass
    assert state() == before
