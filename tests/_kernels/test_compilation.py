"""Compiled kernels: what is said while they are made, and that those kept are of these sources."""

from __future__ import annotations

import ast
import gc
import importlib
import json
import os
import pkgutil
import shutil
import signal
import subprocess
import sys
import threading
import time
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import pytest
from numba.core import event
from numba.core.dispatcher import Dispatcher

import iscat_analysis
from iscat_analysis import _kernels
from iscat_analysis._kernels.kept import Kept
from iscat_analysis.fitting import run as module
from iscat_analysis.fitting.run import compiling

ROOM = "iscat_analysis._kernels"
PACKAGE = Path(iscat_analysis.__file__).parent
INLINED = """
from iscat_analysis._kernels import kernel

@kernel()
def factor():
    return 2.0
"""
CALLER = """
from iscat_analysis._kernels import kernel
from iscat_analysis._kernels.inlined import factor

@kernel()
def scaled(value):
    return factor() * value
"""
LAYOUTS = """
from iscat_analysis._kernels import kernel

@kernel()
def total(values):
    total = 0.0
    for value in values.flat:
        total += value
    return total
"""
SCALE = """
from iscat_analysis._kernels.caller import scaled
print(scaled(3.0), sum(scaled.stats.cache_hits.values()))
"""
WAIT = "print('begun', flush=True)\ninput()\n"
SERVER = """
import json, os, sys, traceback
import numba, numpy
numba.njit(lambda value: value + 1.0)(1.0)
for line in sys.stdin:
    environment, code, *streams = json.loads(line)
    child = os.fork()
    if not child:
        status = 1
        try:
            for stream, name in enumerate(streams, 1):
                os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), stream)
            os.environ.update(environment)
            numba.config.reload_config()
            sys.dont_write_bytecode = True
            sys.path.insert(0, environment["PYTHONPATH"])
            exec(code, {})
            status = 0
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            os._exit(status)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


def kernel(name: str) -> dict[str, SimpleNamespace]:
    """Give the data of the event of a function of a module that is compiled."""
    return {"dispatcher": SimpleNamespace(py_func=SimpleNamespace(__module__=name))}


@pytest.fixture
def new_process(monkeypatch):
    """Begin as a process that has announced nothing."""
    monkeypatch.setattr(module, "ANNOUNCED", threading.Event())


@pytest.mark.usefixtures("new_process")
def test_compilation_is_announced_once_in_a_process(monkeypatch):
    monkeypatch.setattr(module, "PATIENCE_S", 0.0)
    said = []
    with (
        compiling(said.append),
        event.trigger_event("numba:compile", data=kernel(f"{ROOM}.radial")),
    ):
        while not said:
            time.sleep(0.001)
        with event.trigger_event("numba:compile", data=kernel("numba.np.arrayobj")):
            pass
    with (
        compiling(said.append),  # of another movie
        event.trigger_event("numba:compile", data=kernel(f"{ROOM}.scoring")),
    ):
        time.sleep(0.05)
    with event.trigger_event("numba:compile", data=kernel(f"{ROOM}.moving")):
        pass
    assert len(said) == 1
    assert said[0].startswith("compiling the numerical kernels")


@pytest.mark.usefixtures("new_process")
def test_nothing_is_said_of_a_kernel_that_is_quick(monkeypatch):
    monkeypatch.setattr(module, "PATIENCE_S", 0.05)
    said = []
    with compiling(said.append):
        with event.trigger_event("numba:compile", data=kernel(f"{ROOM}.sliding")):
            pass
        time.sleep(0.2)
    assert not said


def test_cycles_are_looked_for_again_once_a_kernel_is_compiled():
    assert gc.isenabled()
    with compiling(print):
        with event.trigger_event("numba:compile", data=kernel(f"{ROOM}.sliding")):
            with event.trigger_event("numba:compile", data=kernel(f"{ROOM}.loops")):
                pass
            assert not gc.isenabled()
        assert gc.isenabled()


@pytest.mark.large
def test_a_picture_is_compiled_without_those_of_other_kinds(tmp_path):
    code = """
from iscat_analysis._kernels.lattice import lattice_row
from iscat_analysis._kernels.radial_rows import radial_signal
from iscat_analysis._kernels.stamp import stamp_signal
from iscat_analysis.config import Config
from iscat_analysis.optics.forward import PixelGrid, forward_model
model = forward_model(Config(), 2000.0)
model.amplitude_image(PixelGrid.region((0, 3), (0, 3), 10.0), 10.0, 10.0, 5.0, 1.0)
print(*(len(kernel.signatures) for kernel in (radial_signal, lattice_row, stamp_signal)))
"""
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.split() == ["1", "0", "0"]


def test_all_that_kernels_take_from_the_package_decides_the_folder():
    """A constant from elsewhere would be compiled in, and not be hashed."""
    for path in (PACKAGE / "_kernels").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [node.module] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            for name in names:
                assert (
                    not name.startswith("iscat_analysis")
                    or name.startswith(ROOM)
                    or name == "iscat_analysis.errors"
                ), f"{path.name} takes {name}"


def test_all_kernels_are_kept_but_those_that_have_no_code_of_their_own():
    for found in pkgutil.iter_modules(_kernels.__path__):
        names = vars(importlib.import_module(f"{ROOM}.{found.name}"))
        for name, dispatcher in names.items():
            if (
                isinstance(dispatcher, Dispatcher)
                and "no_cfunc_wrapper" in dispatcher.targetoptions
            ):
                assert isinstance(dispatcher._cache, Kept), f"{found.name}.{name}"


class Small:
    """A package of few small kernels around the real machinery, and processes that use it."""

    def __init__(self, folder: Path) -> None:
        self.root = folder / "root"
        self.cache = folder / "cache"
        self.kernels = self.root / "iscat_analysis" / "_kernels"
        self.kernels.mkdir(parents=True)
        (self.root / "iscat_analysis" / "__init__.py").touch()
        shutil.copy(PACKAGE / "errors.py", self.root / "iscat_analysis")
        for name in ("__init__.py", "kept.py"):
            shutil.copy(PACKAGE / "_kernels" / name, self.kernels)
        for name, text in (("inlined", INLINED), ("caller", CALLER), ("layouts", LAYOUTS)):
            (self.kernels / f"{name}.py").write_text(text, encoding="utf-8")

    def edit(self, before: str = "2.0", after: str = "200.0") -> None:
        """Change the inlined kernel."""
        path = self.kernels / "inlined.py"
        path.write_text(path.read_text(encoding="utf-8").replace(before, after), encoding="utf-8")

    def environment(self, **changes: str) -> dict[str, str]:
        return os.environ | {
            "PYTHONPATH": str(self.root), "NUMBA_CACHE_DIR": str(self.cache),
            "PYTHONDONTWRITEBYTECODE": "1", **changes,
        }  # fmt: skip

    def run(self, code: str = SCALE, **changes: str) -> tuple[str, str]:
        """Run a program in a copy of a process that has loaded Numba; give both streams."""
        streams = [self.root / name for name in ("out", "err")]
        order = [self.environment(**changes), code, *map(str, streams)]
        status = tell(_server(), json.dumps(order))
        out, err = (path.read_text(encoding="utf-8") for path in streams)
        assert status == "0", err
        return out.strip(), err

    def run_afresh(self, code: str, **changes: str) -> tuple[str, str]:
        """Run a program in a process of its own, with pipes; give both streams."""
        done = subprocess.run(
            [sys.executable, "-c", code], env=self.environment(**changes), cwd=self.root.parent,
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        return done.stdout.strip(), done.stderr

    def start(self, code: str) -> subprocess.Popen[str]:
        """Start a program that is talked to."""
        return subprocess.Popen(
            [sys.executable, "-c", code], env=self.environment(), cwd=self.root.parent,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip

    def files(self) -> list[Path]:
        """Give all files of the cache."""
        return sorted(path for path in self.cache.rglob("*") if path.is_file())


@cache
def _server() -> subprocess.Popen[str]:
    """Start what copies itself for each order; it ends with this process, which it listens to."""
    return subprocess.Popen(
        [sys.executable, "-c", SERVER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )


def tell(process: subprocess.Popen[str], line: str = "go") -> str:
    """Send a line, and give the one that is answered."""
    process.stdin.write(f"{line}\n")
    process.stdin.flush()
    return process.stdout.readline().strip()


@pytest.fixture
def small(tmp_path):
    return Small(tmp_path)


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """Give a package with compiled kernels, to be copied."""
    small = Small(tmp_path_factory.mktemp("compiled"))
    assert small.run() == ("6.0 0", "")
    return small


@pytest.fixture
def kept(compiled, tmp_path):
    """Give a copy, to be damaged."""
    copy = Small(tmp_path)
    shutil.copytree(compiled.cache, copy.cache)
    return copy


def test_an_inlined_kernel_that_is_edited_reaches_its_callers(kept):
    assert kept.run() == ("6.0 1", "")  # control: kept kernels are taken
    kept.edit()
    assert kept.run() == ("600.0 0", "")
    assert kept.run() == ("600.0 1", "")
    kept.edit("200.0", "2.0")
    assert kept.run() == ("6.0 1", "")  # those of before are there still


def test_a_process_that_began_before_an_edit_leaves_its_code_to_none_that_begin_later(small):
    old = small.start(f"from {ROOM} import caller\n{WAIT}{SCALE}")
    assert old.stdout.readline() == "begun\n"
    small.edit()
    shutil.rmtree(small.cache, ignore_errors=True)
    out, _ = old.communicate("go\n", timeout=300)
    assert out.split() == ["6.0", "0"]
    assert small.run() == ("600.0 0", "")


def test_kernels_that_are_loaded_after_an_edit_are_not_kept_as_those_of_before(small):
    early = small.start(f"import {ROOM}\n{WAIT}{SCALE}")
    assert early.stdout.readline() == "begun\n"
    small.edit()
    out, _ = early.communicate("go\n", timeout=300)
    assert out.split() == ["600.0", "0"]
    small.edit("200.0", "2.0")
    assert small.run()[0].startswith("6.0 ")


def test_two_layouts_are_not_confused(small):
    code = """
import numpy as np
from iscat_analysis._kernels.layouts import total
print(total(np.arange(10.0){}), sum(total.stats.cache_hits.values()))
"""
    for hits in ("0", "1"):
        for layout, right in (("", "45.0"), ("[::-2]", "25.0")):
            assert small.run(code.format(layout)) == (f"{right} {hits}", "")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows knows no SIGKILL")
@pytest.mark.parametrize("moment", ["before", "after"])
def test_what_a_killed_process_was_writing_is_not_used(kept, moment):
    (kept.kernels / "caller.py").write_text(
        CALLER.replace("value\n", "value + 1\n"), encoding="utf-8"
    )
    beside = kept.start(f"import {ROOM}\n{WAIT}{SCALE}")
    assert beside.stdout.readline() == "begun\n"
    die = f"""
import os
from iscat_analysis._kernels import inlined
inlined.factor()
replace = os.replace
def dying(*names):
    if {moment!r} == "after":
        replace(*names)
    os.kill(os.getpid(), {int(signal.SIGKILL)})
os.replace = dying
"""
    killed = kept.start(die + SCALE)
    killed.communicate(timeout=300)
    assert killed.returncode == -signal.SIGKILL
    out, _ = beside.communicate("go\n", timeout=300)
    assert out.split() == ["7.0", str(int(moment == "after"))]
    assert kept.run() == ("7.0 1", "")


def _cut(content: bytes) -> bytes:
    return content[: len(content) // 2]


def _flipped(content: bytes) -> bytes:
    """Flip a bit in the middle, where there is code."""
    place = len(content) // 2
    return content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]


@pytest.mark.parametrize("damage", [_cut, _flipped])
def test_kept_kernels_that_are_damaged_are_compiled_again_and_it_is_said(kept, damage):
    (file,) = (path for path in kept.files() if path.name.startswith("caller.scaled"))
    file.write_bytes(damage(file.read_bytes()))
    out, err = kept.run()
    assert out == "6.0 0"
    assert f"{file}: is damaged, and is compiled again" in err
    assert kept.run() == ("6.0 1", "")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows limits no sizes of files")
def test_kernels_that_cannot_be_kept_for_want_of_room_end_no_run(small):
    full = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))\n"
    out, err = small.run_afresh(full + SCALE)
    assert out == "6.0 0"
    assert err.count("compiled kernels cannot be kept in ") == 1
    assert f"{small.cache}" in err
    assert "File too large" in err
    assert "NUMBA_CACHE_DIR" in err
    assert not small.files()


FOLDER = SCALE + "from iscat_analysis._kernels import kept\nprint(kept.folder())\n"


def test_where_kernels_are_kept(small, tmp_path):
    """In the user's cache; in the package where the user has none; nowhere, which is said."""
    blocked, home = tmp_path / "file", tmp_path / "home"
    blocked.write_text("a file is no folder, for whoever runs this", encoding="utf-8")

    def run(home: Path) -> tuple[str, str, str]:
        names = ("HOME", "XDG_CACHE_HOME", "LOCALAPPDATA")
        out, err = small.run(FOLDER, NUMBA_CACHE_DIR="", **dict.fromkeys(names, str(home)))
        assert out.split()[:2] == ["6.0", "0"]
        return out.split()[2], err, home.name

    assert Path(run(home)[0]).is_relative_to(home)
    assert run(home / "x")[1] == ""
    package = small.kernels / "__pycache__"
    assert Path(run(blocked)[0]).parent == package
    shutil.rmtree(package)
    package.touch()
    assert run(blocked)[1].count("compiled kernels cannot be kept in ") == 1


def test_what_decides_machine_code_decides_the_folder(kept):
    """The processor; whether indices are checked.  Not how many threads there are."""
    (folder,) = kept.cache.iterdir()
    processor, _ = kept.run_afresh(FOLDER, NUMBA_CPU_NAME="generic")
    checked, _ = kept.run(FOLDER, NUMBA_BOUNDSCHECK="1")
    for said in (processor, checked):
        assert said.split()[:2] == ["6.0", "0"]
        assert said.split()[2] != str(folder)
    assert kept.run(NUMBA_NUM_THREADS="1") == ("6.0 1", "")


def test_kernels_that_are_not_compiled_at_all_run(small):
    """NUMBA_DISABLE_JIT is for debuggers."""
    code = "from iscat_analysis._kernels.caller import scaled\nprint(scaled(3.0))\n"
    assert small.run(code, NUMBA_DISABLE_JIT="1") == ("6.0", "")
    assert not small.files()


def test_folders_that_nobody_used_for_a_month_are_removed_when_one_is_added(kept):
    (used,) = kept.cache.iterdir()
    days = {"iscat-kernels-old": 40, "iscat-kernels-last-week": 7, "of-somebody-else": 400}
    for name, age in days.items():
        (kept.cache / name).mkdir()
        then = time.time() - 86400.0 * age
        os.utime(kept.cache / name, (then, then))
    kept.edit()
    kept.run()
    names = {path.name for path in kept.cache.iterdir()}
    assert {used.name, "iscat-kernels-last-week", "of-somebody-else"} < names
    assert "iscat-kernels-old" not in names
    assert len(names) == 4
