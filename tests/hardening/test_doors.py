"""What is given in place of a file, and files that declare more than they hold: one line each."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
import tifffile
from hardening.test_hostile_files import modest, refuse
from tiff_files import ASCII, movie, pages_of, write_tiff

import iscat_analysis as ia
from iscat_analysis.movie import open_stack
from iscat_analysis.reading import json_of, toml_of
from iscat_cli import main, main_fit

zarr = pytest.importorskip("zarr")

FRAMES = movie(12, 16, 16)
Line = Callable[..., str]
_HANGS_S = 100  # a guard; all of these take seconds at most, with what they import


@pytest.fixture(autouse=True)
def never_waiting() -> Iterator[None]:
    """End a test that waits for what never comes, or that takes the square of its size."""

    def give_up(*_: object) -> None:
        raise AssertionError("it hangs")

    before = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(_HANGS_S)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture
def line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> Line:
    """Run a command that must fail, and give its only line."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str) -> str:
        program = main_fit if arguments[0] == "fit" else main
        status = program([*arguments[1:]] if program is main_fit else [*arguments])
        lines = capsys.readouterr().err.strip().splitlines()
        assert status in (1, 2)
        assert len(lines) == 1, lines
        assert "unexpected" not in lines[0]
        return lines[0]

    return run


# ---- no regular file -----------------------------------------------------------------------------

READ_WHOLE = {
    "configuration": ("fit", "absent.tif", "--config", "{}"),
    "scheduler": ("fit", "absent.tif", "--scheduler-file", "{}"),
    "events": ("species", "{}"),
    "samples": ("kd", "{}", "--model", "dimer"),
    "standards": ("calibrate", "mass", "{}", "--standards", "66,146"),
    "movies": ("batch", "{}", "--out", "day"),
    "movie": ("fit", "{}"),
}


@pytest.mark.parametrize("kind", ["pipe", "/dev/zero", "folder", "loop", "name", "large"])
@pytest.mark.parametrize("command", READ_WHOLE.values(), ids=list(READ_WHOLE))
def test_only_regular_files_are_read(command: tuple[str, ...], kind: str, line: Line) -> None:
    path = Path(kind)
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "loop":
        path.symlink_to(path)
    elif kind == "name":
        path = Path("n" * 300)
    elif kind == "large":
        with path.open("wb") as file:
            file.truncate(3 * 10**9)
    with modest():
        said = line(*(part.format(path) for part in command))
    assert str(path) in said


@pytest.mark.parametrize("command", ["view", "export"])
def test_results_of_impossible_names(command: str, line: Line) -> None:
    more = ["--to", "trackpy"] if command == "export" else []
    assert "n" * 300 in line(command, "n" * 300, *more)


@pytest.mark.parametrize("given", ["~nosuchuser/a.tif", "n" * 300, "a\0b.tif"])
def test_impossible_names_in_tables(given: str, line: Line) -> None:
    Path("samples.csv").write_text(f"path,concentration_nm\n{given},1\n", encoding="utf-8")
    line("batch", "samples.csv", "--out", "day")
    line("kd", "samples.csv", "--model", "dimer")


@pytest.mark.parametrize(
    ("out", "said"),
    [
        ("/", "choose another --out"),
        ("loop", "choose another --out"),
        ("loop/inside", "choose another --out"),
        ("n" * 300, "File name too long"),
        ("n" * 300 + "/inside", "File name too long"),
    ],
)
def test_impossible_folders(out: str, said: str, line: Line) -> None:
    tifffile.imwrite("movie.tif", FRAMES)
    Path("loop").symlink_to("loop")
    assert said in line("fit", "movie.tif", "--out", out)


# ---- texts ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("a = " + "9" * 5000, "too many digits"),
        ("a = " + "[" * 5000, "nested too deep"),
        ("a = " + "{a=" * 5000, "nested too deep"),
        ("a." * 50_000 + "b = 1", "a key of more than 64 parts"),
        ("[" + "a." * 50_000 + "b]", "a key of more than 64 parts"),
        ("a = {" + "a . " * 50_000 + "b = 1}", "a key of more than 64 parts"),
    ],
    ids=["digits", "lists", "tables", "dots", "headings", "inside"],
)
def test_texts_that_exhaust(text: str, why: str, line: Line) -> None:
    Path("setup.toml").write_text(text, encoding="utf-8")
    assert why in line("fit", "absent.tif", "--config", "setup.toml")
    Path("movies.toml").write_text(text, encoding="utf-8")
    assert why in line("batch", "movies.toml", "--out", "day")


def test_texts_that_do_not() -> None:
    """Control: points are no keys, and neither are remarks."""
    text = 'a = "' + "." * 1000 + '"\nb = [' + "1.5, " * 1000 + "]  # " + "." * 1000
    assert len(toml_of(text)["b"]) == 1000
    with pytest.raises(ValueError, match="nested too deep"):
        json_of("[" * 100_000)


def test_simulations_beyond_memory() -> None:
    simulate = {"camera.pixel_size_nm": 80.0, "simulation.frames": 10**9}
    with pytest.raises(ia.ConfigError, match=r"simulation\.frames: .*10000000"):
        ia.configure(None, settings=simulate)
    mover = {"count": 100_000, "d_um2_s": 1.0}
    with pytest.raises(ia.ConfigError, match="100000 movers in frames = 2000 have"):
        ia.configure(None, settings={"simulation.frames": 2000, "simulation.movers": [mover]})


# ---- the environment and the network -------------------------------------------------------------


def test_an_environment_that_numba_refuses() -> None:
    code = "import sys; from iscat_cli import main; sys.exit(main(['bounds']))"
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"NUMBA_NUM_THREADS": "0"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert "Numba refuses a variable of the environment" in done.stderr
    assert "\n" not in done.stderr.strip()


def test_no_window_is_needed(tmp_path: Path) -> None:
    table = tmp_path / "events.csv"
    rng = np.random.default_rng(1)
    pd.DataFrame({"mass_kda": rng.normal(66, 5, 100), "sigma_mass_kda": 5.0}).to_csv(table)
    code = "import sys; from iscat_cli import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "species", str(table), "--draws", "0", "--k", "1"]
    command += ["--out", str(tmp_path / "out")]
    environment = os.environ | {"MPLBACKEND": "nonsense"}
    assert subprocess.run(command, env=environment, check=False).returncode == 0
    assert (tmp_path / "out" / "species.html").is_file()


@pytest.mark.parametrize("address", ["tls://127.0.0.1:1", "ucx://127.0.0.1:1", "ws://a:1", "a:b:c"])
def test_addresses_of_other_kinds(address: str, line: Line) -> None:
    assert "tcp://10.0.0.1:8786" in line("fit", "absent.tif", "--scheduler", address)


@pytest.fixture
def silent() -> Iterator[str]:
    """Give the address of somebody who accepts, and says nothing."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        held: list[socket.socket] = []
        thread = threading.Thread(target=lambda: held.append(server.accept()[0]), daemon=True)
        thread.start()
        yield f"tcp://127.0.0.1:{server.getsockname()[1]}"
        for connection in held:
            connection.close()


def test_a_scheduler_that_says_nothing(silent: str, line: Line) -> None:
    assert "no Dask scheduler answers there" in line("fit", "absent.tif", "--scheduler", silent)


# ---- movies that declare more than they hold -----------------------------------------------------

OME = (
    '<?xml version="1.0"?><OME><Image><Pixels SizeT="{}" SizeC="1" SizeZ="1">{}'
    "</Pixels></Image></OME>"
)


def _ome(path: Path, text: str, frames: int = 2) -> Path:
    tags = {0: {270: (ASCII, text)}}
    return write_tiff(path, pages_of(movie(frames)), (10, 14), page_tags=tags)


def _block(name: str, frame: int, image: int = 0, planes: int = 1) -> str:
    return (
        f'<TiffData FirstT="{frame}" IFD="{image}" PlaneCount="{planes}">'
        f'<UUID FileName="{name}">urn:uuid:{frame}</UUID></TiffData>'
    )


def test_a_set_of_more_frames_than_its_files_can_hold(tmp_path: Path) -> None:
    blocks = _block("a.tif", 0, planes=10**8) + _block("b.tif", 10**8, planes=10**8)
    path = _ome(tmp_path / "a.tif", OME.format(2 * 10**8, blocks))
    (tmp_path / "b.tif").write_bytes(bytes(1000))
    refuse(path, "describes 200000000 frames, but its files beside it have")


def test_a_set_of_twenty_thousand_blocks(tmp_path: Path) -> None:
    blocks = "".join(_block(f"{k}.tif", k) for k in range(20_000))
    path = _ome(tmp_path / "0.tif", OME.format(20_000, blocks))
    (tmp_path / "1.tif").write_bytes(bytes(10**6))
    refuse(path, "of which 2.tif is not beside it")
    again = "".join(_block("ab"[k % 2] + ".tif", 0, planes=20_000) for k in range(20_000))
    path = _ome(tmp_path / "a.tif", OME.format(20_000, again))
    (tmp_path / "b.tif").write_bytes(bytes(10**6))
    refuse(path, "its TiffData blocks are of more than 20000 frames")


@pytest.mark.parametrize("name", ["b.tif", "n" * 300 + ".tif", "a\nb.tif", ""])
def test_members_that_cannot_be_read(tmp_path: Path, name: str) -> None:
    blocks = _block("a.tif", 0) + _block(name or "/dev/zero", 1)
    path = _ome(tmp_path / "a.tif", OME.format(2, blocks).replace("\n", "&#10;"))
    if name == "b.tif":
        (tmp_path / name).touch()
    with pytest.raises(ia.DataError, match=r"is empty|is not beside it|other folders") as caught:
        open_stack(path)
    assert len(str(caught.value).splitlines()) == 1 or "\n" in name


def test_groups_in_groups(tmp_path: Path) -> None:
    path = tmp_path / "deep.h5"
    with h5py.File(path, "w") as file:
        group = file
        for _ in range(3000):
            group = group.create_group("g")
        group["movie"] = FRAMES
    refuse(path, "holds no frames")
    with open_stack(f"{path}::{'g/' * 3000}movie") as stack:  # named, it is found
        assert stack.shape == FRAMES.shape


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<u2', 'fortran_order': False, 'shape': (5, 12, 14",
        "{'descr': '<u2', 'fortran_order': False, 'shape': (-5, 12, 14), }",
        "{'descr': '<u2', 'fortran_order': False, 'shape': (5, -12, -14), }",
        "{'descr': '<u2', 'fortran_order': False, 'shape': (" + "9" * 5000 + ", 12, 14), }",
        "{'descr': '<u2', 'fortran_order': False, 'shape': (5L, 12L",
        "[" * 9000,
        "{'descr': [('a', '<u2')], 'fortran_order': False, 'shape': (5, 12, 14), }",
    ],
    ids=["bracket", "negative", "two negative", "digits", "old", "deep", "fields"],
)
def test_headers_of_numpy(tmp_path: Path, header: str) -> None:
    path = tmp_path / "movie.npy"
    text = header.encode()
    path.write_bytes(b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(2000))
    refuse(path, "movie.npy: ")


# ---- Zarr ----------------------------------------------------------------------------------------

LAYOUTS = {
    "v2": {"zarr_format": 2, "chunks": (4, 8, 16)},
    "v3": {"zarr_format": 3, "chunks": (4, 8, 16)},
    "shards": {"zarr_format": 3, "chunks": (2, 8, 8), "shards": (4, 16, 16)},
}


def _zarr(path: Path, layout: str) -> Path:
    stored = zarr.create_array(path, shape=FRAMES.shape, dtype="u2", **LAYOUTS[layout])
    stored[:] = FRAMES
    return path


def _chunks(path: Path) -> list[Path]:
    return sorted(p for p in path.rglob("*") if p.is_file() and p.name.strip(".0123456789") == "")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_movies_in_zarr_are_read(tmp_path: Path, layout: str) -> None:
    """Control: nothing is wrong with these."""
    with open_stack(_zarr(tmp_path / "m.zarr", layout)) as stack:
        np.testing.assert_array_equal(stack.read(0, 12), FRAMES)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("damage", ["missing", "pipe", "device", "noise", "cut", "empty", "long"])
def test_damaged_chunks(tmp_path: Path, layout: str, damage: str) -> None:
    path = _zarr(tmp_path / "m.zarr", layout)
    chunk = _chunks(path)[-1]
    content = chunk.read_bytes()
    chunk.unlink()
    if damage == "pipe":
        os.mkfifo(chunk)
    elif damage == "device":
        chunk.symlink_to("/dev/zero")
    elif damage != "missing":
        changed = {
            "noise": np.random.default_rng(1).bytes(len(content)), "cut": content[:-9],
            "empty": b"", "long": content + bytes(10**6),
        }  # fmt: skip
        chunk.write_bytes(changed[damage])
    refuse(path, "m.zarr")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_missing_chunk_is_named(tmp_path: Path, layout: str) -> None:
    path = _zarr(tmp_path / "m.zarr", layout)
    _chunks(path)[-1].unlink()
    refuse(path, "frames 8 to 11 is missing|it holds .* files and needs")
    path = tmp_path / "part.zarr"  # chunks of zeros alone are not written
    stored = zarr.create_array(path, shape=FRAMES.shape, dtype="u2", **LAYOUTS[layout])
    stored[:] = np.where(np.arange(12)[:, None, None] < 10, FRAMES, 0)
    if layout == "shards":
        refuse(path, "lacks some of frames 8 to 11")


def test_a_chunk_that_goes_missing_later(tmp_path: Path) -> None:
    path = _zarr(tmp_path / "m.zarr", "v3")
    with open_stack(path) as stack:
        _chunks(path)[-1].unlink()
        np.testing.assert_array_equal(stack.read(0, 4), FRAMES[:4])
        with pytest.raises(ia.DataError, match="is missing"):
            stack.read(8, 12)


@pytest.mark.parametrize(
    ("shape", "chunks", "why"),
    [
        ((10**9, 10**5, 10**5), (1, 1000, 1000), "would grow"),
        ((4, 50_000, 50_000), (4, 50_000, 50_000), "in chunks of"),
        ((4000, 1000, 1000), (1, 100, 100), "would grow"),
        ((100, 100, 100), (1, 10, 10), "files and needs 10000"),
    ],
)
def test_arrays_without_data(
    tmp_path: Path, shape: tuple[int, ...], chunks: tuple[int, ...], why: str
) -> None:
    zarr.create_array(tmp_path / "m.zarr", shape=shape, chunks=chunks, dtype="u2")
    refuse(tmp_path / "m.zarr", why)


def test_what_is_no_movie() -> None:
    for wrong in (5, None, np.int64(5), np.zeros(3), [1, 2], object()):
        with pytest.raises(ia.DataError, match=r"array|int64|float64"):
            open_stack(wrong)
