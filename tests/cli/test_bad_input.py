"""Bad input, through the real commands: one clear line, status 1 or 2, nothing half-written."""

from __future__ import annotations

import re
import signal
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
import tifffile
from commands import deaf
from forks import fork, send
from numpy.typing import NDArray

from iscat_cli import main, main_fit

UNUSABLE, USAGE, INTERRUPTED = 1, 2, 130

FRAMES, SIDE = 24, 48

Run = Callable[..., str]


def _counts(dtype: str = "u2") -> NDArray:
    return np.random.default_rng(1).poisson(1000.0, (FRAMES, SIDE, SIDE)).astype(dtype)


def _save(path: Path, counts: NDArray, **options: object) -> Path:
    tifffile.imwrite(path, counts, photometric="minisblack", **options)
    return path


@pytest.fixture
def movie(tmp_path: Path) -> Path:
    """Write a movie with nothing wrong, and nothing in it."""
    return _save(tmp_path / "movie.tif", _counts())


NONE = ["--set", "detection.false_alarms_per_movie=1e-6"]
"""Finds nothing in a movie with nothing in it."""

GOOD = ["--set", "camera.pixel_size_nm=84.4", "--background", "0:12", "--no-posterior"]
PIXEL, LATE = GOOD[:2], [*GOOD[:2], *GOOD[4:]]


@pytest.fixture
def refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run iscat-fit, which must refuse in one line and leave the folder as it was."""

    def run(path: Path, *arguments: str, status: int = UNUSABLE, options: list[str] = GOOD) -> str:
        before = _listing(tmp_path)
        assert main_fit([str(path), *options, *arguments, "--quiet"]) == status
        captured = capsys.readouterr()
        assert captured.out == ""
        (line,) = captured.err.splitlines()
        assert line.startswith("iscat-fit: error: ")
        for sign_of_a_bug in ("unexpected", "Traceback", "--debug", "pydantic"):
            assert sign_of_a_bug not in line
        assert _listing(tmp_path) == before
        return line

    return run


def _listing(folder: Path) -> dict[str, int]:
    return {
        str(p.relative_to(folder)): p.stat().st_size if p.is_file() else -1
        for p in folder.rglob("*")
    }


def test_the_movie_of_these_tests_is_good_and_its_result_is_kept(
    refused: Run, movie: Path, capsys
) -> None:
    """Control: without a fault it is analysed."""
    assert main_fit([str(movie), *GOOD, *NONE, "--quiet"]) == 0
    assert "0 events" in capsys.readouterr().out
    assert (movie.with_suffix(".iscat") / "report.html").is_file()
    assert "--overwrite" in refused(movie)


def test_several_movies_are_not_one(refused: Run, movie: Path, tmp_path: Path) -> None:
    second = _save(tmp_path / "second.tif", _counts())
    line = refused(movie, str(second), status=USAGE)
    assert "2 movies were given" in line
    assert "for movie in *.tif" in line


# ---- files and counts ------------------------------------------------------------------------


def _bytes(content: bytes) -> Callable[[Path], None]:
    return lambda path: (path.write_bytes(content), None)[1]


def _part(share: float) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        content = _save(path, _counts()).read_bytes()
        path.write_bytes(content[: int(share * len(content))])

    return write


def _with(frame: Any, value: float, dtype: str = "f4") -> Callable[[Path], None]:
    """Write a movie whose pixel, or whole frame, has another value."""

    def write(path: Path) -> None:
        counts = _counts(dtype)
        counts[frame] = value
        _save(path, counts)

    return write


def _rgb(path: Path) -> None:
    tifffile.imwrite(path, np.zeros((4, 32, 32, 3), dtype="u1"), photometric="rgb")


def _ratios(path: Path) -> None:
    counts = _counts("f4")
    _save(path, counts / counts[:12].mean(axis=0))


def _heights(path: Path) -> None:
    _save(path, _counts().reshape(1, FRAMES, 1, SIDE, SIDE), metadata={"axes": "TZCYX"})


FRAME_17 = (17, 5, 6)
MOVIES = {
    "absent": (lambda _: None, "a.tif"),
    "folder": (lambda path: path.mkdir(), "a.tif"),
    "empty": (_bytes(b""), "a.tif"),
    "picture": (_bytes(b"PNG and so on" * 100), "a.tif"),
    "header": (_bytes(b"II*\0" + bytes(40)), "a.tif"),
    "a fifth": (_part(0.2), "truncated|ends|incomplete|missing"),
    "most": (_part(0.7), "truncated|ends|incomplete|missing"),
    "nearly all": (_part(0.999), "truncated|ends|incomplete|missing"),
    "one frame": (lambda path: _save(path, _counts()[0]), "a.tif.*frame"),
    "colours": (_rgb, "colour|RGB"),
    "nan": (_with((3, 5, 6), np.nan), "frame 3"),
    "nan later": (_with(FRAME_17, np.nan), "frame 17"),
    "infinite": (_with(FRAME_17, np.inf), "frame 17"),
    "negative": (_with(FRAME_17, -50.0), "frame 17"),
    "saturated": (_with(20, 65535, "u2"), "frame 20 is saturated"),
    "nothing": (_with(slice(None), 0, "u2"), "are all the same"),
    "ratios": (_ratios, "a.tif: frame 0 is ratiometric.*raw counts"),
    "heights": (_heights, r"Z \(height\) of length 24 and T \(time\) of length 1"),
}


@pytest.mark.parametrize("kind", MOVIES)
def test_what_is_no_movie(kind: str, refused: Run, tmp_path: Path) -> None:
    write, words = MOVIES[kind]
    path = tmp_path / "a.tif"
    write(path)
    for options in (GOOD, PIXEL) if kind == "ratios" else (GOOD,):  # with a background, without
        line = refused(path, options=options)
        assert "a.tif" in line
        assert re.search(words, line)


@pytest.mark.parametrize("background", [["--background", "0:12"], []])
def test_a_pixel_without_a_number_in_every_frame(
    background: list[str], refused: Run, tmp_path: Path
) -> None:
    """No frame is left in which lines, or noise, could be looked for before they are refused."""
    counts = np.tile(_counts("f4"), (2, 1, 1))  # enough for two windows
    counts[:, 20, 9] = np.nan
    options = ["--set", "camera.pixel_size_nm=84.4", "--no-posterior", *background]
    line = refused(_save(tmp_path / "odd.tif", counts), options=options)
    assert "frame 0 is NaN or infinite in 1 pixel, the first at y = 20, x = 9" in line


def test_a_zero_frame_is_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _with(7, 0, "u2")(tmp_path / "dropped.tif")
    assert main_fit([str(tmp_path / "dropped.tif"), *GOOD, *NONE]) == 0
    assert "frame 7 of" in capsys.readouterr().err


def test_pixel_size_of_the_sensor_in_the_metadata(refused: Run, tmp_path: Path) -> None:
    path = tmp_path / "movie.ome.tif"
    sizes = {"PhysicalSizeX": 6.5, "PhysicalSizeY": 6.5}
    _save(path, _counts(), ome=True, metadata={"axes": "TYX", **sizes})
    line = refused(path, options=GOOD[2:])
    assert "sample plane" in line
    assert "6500" in line


# ---- options ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "options", "words"),
    [
        ("--set camera.offset_adu=5000", GOOD, "camera.offset_adu"),
        ("--background 0:24", LATE, "24.*background|background.*24"),
        ("--background 0:25", LATE, "24.*background|background.*24"),
        ("--background 0:4000", LATE, "24.*background|background.*24"),
        ("", PIXEL, "--background"),  # too short for windows that slide
        ("--frames 12:40", GOOD, "24"),
        ("--frames 6:20", GOOD, "overlap"),
        ("", GOOD[2:], "pixel size.*camera.pixel_size_nm"),
    ],
)
def test_options_that_do_not_suit_the_movie(
    arguments: str, options: list[str], words: str, refused: Run, movie: Path
) -> None:
    assert re.search(words, refused(movie, *arguments.split(), options=options))


@pytest.mark.parametrize("text", ["12", "12-24", "a:b", "24:12", "12:12", "-1:5", "1:2:3", ""])
def test_syntax_of_frames(text: str, refused: Run, movie: Path) -> None:
    assert "A:B" in refused(movie, f"--frames={text}", status=USAGE)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ("camera.pixel_size_nm=0.0844", "camera.pixel_size_nm"),  # micrometres
        ("optic.na=1.3", "did you mean optics"),
        ("fit.roi_nm=9000", "more than the field"),
        ("calibration.gradient_per_kda=3.1e-5", "wrong sign"),
        ("optics.na", "section.key=value"),
        ("particle.kind=gold optics.wavelength_nm=2500 fit.roi_nm=3000", "gold"),
    ],
)
def test_impossible_settings(settings: str, expected: str, refused: Run, movie: Path) -> None:
    """One of each kind: what single keys refuse is tested with the configuration."""
    given = [word for setting in settings.split() for word in ("--set", setting)]
    options = GOOD[2:] if "pixel_size" in settings else GOOD
    assert expected in refused(movie, *given, options=options, status=USAGE)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"[camera]\npixelsize_nm = 84.4\n", "setup.toml.*pixel_size_nm"),
        (b"\xff\xfe\x00\x01", "setup.toml"),
    ],
)
def test_unreadable_configurations(
    content: bytes, words: str, refused: Run, movie: Path, tmp_path: Path
) -> None:
    setup = tmp_path / "setup.toml"
    setup.write_bytes(content)
    assert re.search(words, refused(movie, "--config", str(setup), status=USAGE))


def test_a_map_of_another_size(refused: Run, movie: Path, tmp_path: Path) -> None:
    gain = _save(tmp_path / "gain.tif", np.ones((9, 9), dtype="f4"))
    line = refused(movie, "--set", f"camera.gain_e_per_adu={gain}")
    assert "gain.tif" in line
    assert "9 x 9" in line


# ---- output ----------------------------------------------------------------------------------


@pytest.mark.parametrize("overwrite", [[], ["--overwrite"]])
@pytest.mark.parametrize(
    ("out", "named"), [("thesis", "thesis"), ("movie.tif", "file"), ("movie.tif/out", "movie.tif")]
)
def test_output_folder_of_somebody_else(
    out: str, named: str, overwrite: list[str], refused: Run, movie: Path, tmp_path: Path
) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1.tex").write_text("It was a dark background.")
    assert named in refused(movie, "--out", str(tmp_path / out), *overwrite)


# ---- simulate and bounds -------------------------------------------------------------------------


def _simulation(folder: Path, text: str) -> Path:
    setup = folder / "simulation.toml"
    setup.write_text(text)
    return setup


PLACED = "[camera]\npixel_size_nm = 84.4\n[[simulation.events]]\n"


@pytest.mark.parametrize(
    ("text", "status", "expected"),
    [
        (f"{PLACED}frame = 2\nx_px = 128.0\ny_px = 5.0\n", USAGE, "outside"),
        (f"{PLACED}frame = 400\nx_px = 12.0\ny_px = 5.0\n", USAGE, "400"),
        ("[simulation]\nframes = 4\n", USAGE, "pixel_size_nm"),
        (
            "[camera]\npixel_size_nm = 84.4\ngain_e_per_adu = 1.0\n"
            "[simulation]\nphotons_per_pixel = 1e6\n",
            USAGE,
            "16 bits",
        ),
        (
            '[camera]\npixel_size_nm = 84.4\n[simulation]\nbackground = "none.tif"\n',
            UNUSABLE,
            "none.tif",
        ),
    ],
)
def test_impossible_simulations(
    text: str, status: int, expected: str, tmp_path: Path, capsys
) -> None:
    setup = _simulation(tmp_path, text)
    out = tmp_path / "out" / "movie.tif"
    assert main(["simulate", "--config", str(setup), "--out", str(out), "--quiet"]) == status
    captured = capsys.readouterr()
    (line,) = captured.err.splitlines()
    assert expected in line
    assert captured.out == ""
    assert not out.parent.exists()


# ---- without --quiet, and interrupted ------------------------------------------------------------


def test_progress_does_not_hide_the_one_error(movie: Path, tmp_path: Path, capsys) -> None:
    """As a user sees it: nothing is asked to be quiet."""
    counts = _counts("f4")
    counts[20, 5, 5] = np.nan
    path = _save(tmp_path / "late.tif", counts)
    assert main_fit([str(path), *GOOD]) == UNUSABLE
    shown = capsys.readouterr()
    assert shown.out == ""
    errors = [line for line in shown.err.splitlines() if "error" in line]
    assert len(errors) == 1
    assert "frame 20" in errors[0]
    assert not path.with_suffix(".iscat").exists()
    assert movie.exists()


def _interrupted(
    command: Callable[[list[str]], int], arguments: list[str], begun: Callable[[str], bool]
) -> tuple[int | None, str]:
    """Interrupt a command once it has begun; give its status, and what it said."""
    with TemporaryDirectory() as folder:
        log = Path(folder) / "err"
        process = fork(command, arguments, folder=Path(folder), err=log)
        try:
            while process.is_alive() and not (log.exists() and begun(log.read_text())):
                time.sleep(0.02)
            send(process, signal.SIGINT)
            process.join(120)
        finally:
            process.kill()
        return process.exitcode, log.read_text()


@pytest.mark.parametrize("command", ["simulate", "fit"])
def test_ctrl_c_that_goes_unanswered(command: str, tmp_path: Path) -> None:
    """A process that does not answer an interrupt is ended, and leaves nothing half-written."""
    setup = _simulation(
        tmp_path,
        "[camera]\npixel_size_nm = 84.4\n[background]\nframes = [0, 10]\n"
        "[posterior]\nenabled = false\n[calibration]\ngradient_per_kda = -3.1e-5\n"
        "[simulation]\nframes = 20\n",
    )
    movie = tmp_path / "movie.tif"
    simulate = ["simulate", "--config", str(setup), "--out", str(movie)]
    if command == "fit":
        assert main([*simulate, "--quiet"]) == 0
    left = _listing(tmp_path)
    fit = ["fit", str(movie), "--config", str(setup)]

    def begun(said: str) -> bool:
        if "deaf" not in said:
            return False
        assert len(_listing(tmp_path)) > len(left)
        return True

    status, said = _interrupted(deaf, simulate if command == "simulate" else fit, begun)
    assert status == -signal.SIGINT  # which a shell gives as 130
    assert "interrupted: SIGINT was received" in said
    assert _listing(tmp_path) == left


@pytest.mark.parametrize("stage", ["simulate", "posterior"])
def test_ctrl_c_midway(stage: str, tmp_path: Path) -> None:
    """An interrupt leaves no partial movie and no partial results, and says so in one line."""
    setup = _simulation(
        tmp_path,
        "[camera]\npixel_size_nm = 84.4\n[background]\nframes = [0, 10]\n"
        "[posterior]\nsteps = 1000000\n[calibration]\ngradient_per_kda = -3.1e-5\n"
        f"[simulation]\nshape = [64, 64]\nframes = {20 if stage == 'posterior' else 60000}\n"
        "[[simulation.events]]\nframe = 10\nx_px = 30\ny_px = 31\nmass_kda = 3000\n",
    )
    movie = tmp_path / "movie.tif"
    simulate = ["simulate", "--config", str(setup), "--out", str(movie)]
    if stage == "posterior":
        assert main([*simulate, "--quiet"]) == 0
    left = _listing(tmp_path)

    def begun(said: str) -> bool:
        if stage == "posterior":
            return "detect: 8 of 8" in said
        return bool(list(tmp_path.glob("movie.tif.*.partial")))

    fit = ["fit", str(movie), "--config", str(setup)]
    status, said = _interrupted(main, simulate if stage == "simulate" else fit, begun)
    assert status == INTERRUPTED
    assert len([line for line in said.splitlines() if "error: interrupted" in line]) == 1
    assert "Traceback" not in said
    if stage == "simulate":
        assert _listing(tmp_path) == left
    else:
        kept = movie.with_suffix(".iscat")
        assert not kept.exists() or (kept / "fits.csv").is_file()
        assert {p.name for p in tmp_path.iterdir()} <= {
            "movie.tif", "movie.truth.csv", "simulation.toml", "movie.iscat",
        }  # fmt: skip
