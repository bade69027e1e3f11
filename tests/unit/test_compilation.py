"""Compiled kernels: what is said while they are made, and where they are kept."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from numba.core import event

import iscat_analysis
from iscat_analysis import _kernels
from iscat_analysis._kernels import checksums
from iscat_analysis.fitting import compilation as module
from iscat_analysis.fitting.compilation import compiling

ROOM = "iscat_analysis._kernels"


def kernel(name: str) -> dict[str, SimpleNamespace]:
    """Give the data of the event of a function of a module that is compiled."""
    return {"dispatcher": SimpleNamespace(py_func=SimpleNamespace(__module__=name))}


def test_compilation_is_announced_in_one_line_once(monkeypatch):
    monkeypatch.setattr(module, "PATIENCE_S", 0.0)
    said = []
    with compiling(said.append):
        with event.trigger_event("numba:compile", data=kernel(f"{ROOM}.radial")):
            while not said:
                time.sleep(0.001)
            with event.trigger_event("numba:compile", data=kernel("numba.np.arrayobj")):
                pass
        for _ in range(2):
            with event.trigger_event("numba:compile", data=kernel(f"{ROOM}.scoring")):
                time.sleep(0.05)
    with event.trigger_event("numba:compile", data=kernel(f"{ROOM}.moving")):
        pass
    assert said == ["compiling the numerical kernels, once per installation…"]


def test_nothing_is_said_of_a_kernel_that_is_quick(monkeypatch):
    monkeypatch.setattr(module, "PATIENCE_S", 0.05)
    said = []
    with compiling(said.append):
        with event.trigger_event("numba:compile", data=kernel(f"{ROOM}.sliding")):
            pass
        time.sleep(0.2)
    assert not said


@pytest.mark.large
def test_a_picture_is_compiled_without_those_of_other_kinds(tmp_path):
    code = """
from iscat_analysis._kernels.lattice_rows import lattice_signal
from iscat_analysis._kernels.radial_rows import radial_signal
from iscat_analysis._kernels.stamp import stamp_signal
from iscat_analysis.config import Config
from iscat_analysis.optics.forward import PixelGrid, forward_model
model = forward_model(Config(), 2000.0)
model.amplitude_image(PixelGrid.region((0, 3), (0, 3), 10.0), 10.0, 10.0, 5.0, 1.0)
print(*(len(kernel.signatures) for kernel in (radial_signal, lattice_signal, stamp_signal)))
"""
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.split() == ["1", "0", "0"]


SUPPORT = """
import numpy as np
from iscat_analysis._kernels.support import supported
from iscat_analysis.fitting import compilation

compilation.PATIENCE_S = 3600.0  # a busy machine takes longer, and says so
with compilation.compiling(print):
    edge = np.array([-100.0, 100.0])
    places = np.array([[0, 0, 50, 1, 0], [900, 0, 50, 1, 0]], dtype=float)
    print(*supported(places, edge, edge, 5.0, 500.0, 0.0, 100.0, 1.0))
    print(sum(supported.stats.cache_hits.values()))
"""


def supported(folder, *, before=""):
    """Run a kernel that is kept in a folder, and give what is printed."""
    return subprocess.run(
        [sys.executable, "-c", before + SUPPORT], env=os.environ | {"NUMBA_CACHE_DIR": str(folder)},
        capture_output=True, text=True, check=True,
    ).stdout.splitlines()  # fmt: skip


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """Give a folder that holds a kernel."""
    folder = tmp_path_factory.mktemp("kernels")
    assert supported(folder) == ["True False", "0"]
    return folder


@pytest.fixture
def kept(compiled, tmp_path):
    """Give a copy of it to damage."""
    return Path(shutil.copytree(compiled, tmp_path / "kernels"))


def _cut(kept: bytes) -> bytes:
    return kept[: len(kept) // 2]


def _flipped(kept: bytes) -> bytes:
    """Flip a bit in the middle, where there is code."""
    place = len(kept) // 2
    return kept[:place] + bytes([kept[place] ^ 1]) + kept[place + 1 :]


@pytest.mark.parametrize(
    ("damage", "suffix"),
    [
        (_cut, "nbi"),
        (_flipped, "nbc"),
        *(
            pytest.param(*case, marks=pytest.mark.large)
            for case in ((_cut, "nbc"), (_flipped, "nbi"))
        ),
    ],
)
def test_kept_kernels_that_are_damaged_are_compiled_again(kept, suffix, damage):
    (file,) = kept.glob(f"*/*.{suffix}")
    file.write_bytes(damage(file.read_bytes()))
    assert supported(kept) == ["True False", "0"]


def test_kernels_that_nobody_vouches_for_are_compiled_again(kept):
    """The process that wrote them was killed, perhaps while it wrote."""
    (listed,) = kept.glob("*/checksums.json")
    listed.unlink()
    assert supported(kept) == ["True False", "0"]
    assert supported(kept) == ["True False", "1"]  # control: those that are listed are taken


def test_a_process_does_not_vouch_for_what_others_compiled(kept):
    """A file is damaged while a process runs that takes another file from the same folder."""
    (file,) = kept.glob("*/support.*.nbc")
    whole = file.read_bytes()
    damage = f"""
import pathlib
from iscat_analysis import _kernels
pathlib.Path({str(file)!r}).write_bytes({_flipped(whole)!r})
import numpy as np
from iscat_analysis._kernels.lines import largest
largest(np.zeros(3))
"""
    subprocess.run(
        [sys.executable, "-c", damage], env=os.environ | {"NUMBA_CACHE_DIR": str(kept)},
        check=True,
    )  # fmt: skip
    assert supported(kept) == ["True False", "0"]  # removed, and compiled again


def _list_in(folder: Path, name: str, content: bytes) -> None:
    (folder / f"{name}-1.py311.1.nbc").write_bytes(content)


def test_the_list_keeps_what_others_wrote_into_it(tmp_path):
    for name in ("a.f", "b.g"):
        _list_in(tmp_path, name, name.encode())
        checksums.record(str(tmp_path), (f"{name}-1.",))
    checksums.remove_damaged(str(tmp_path))
    assert len(list(tmp_path.glob("*.nbc"))) == 2
    _list_in(tmp_path, "a.f", b"damaged")
    checksums.record(str(tmp_path), ("b.g-1.",))
    checksums.remove_damaged(str(tmp_path))
    assert [path.name for path in tmp_path.glob("*.nbc")] == ["b.g-1.py311.1.nbc"]


def test_a_process_that_lives_on_lists_what_it_compiled(tmp_path):
    """Others that start meanwhile would compile it again."""
    code = """
import json, pathlib, sys
import numpy as np
from iscat_analysis._kernels.lines import largest
for values in (np.zeros(3), np.zeros(3, np.float32)):
    largest(values)
(listed,) = pathlib.Path(sys.argv[1]).glob("*/checksums.json")
print(*json.loads(listed.read_text()))
"""
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True,
        env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)},
    )  # fmt: skip
    assert "lines.largest-" in done.stdout


def test_processes_that_end_together_lose_no_entry(tmp_path):
    code = """
import sys
from iscat_analysis._kernels import checksums
sys.stdin.readline()
for k in range(20):
    checksums.record(sys.argv[1], (f"{sys.argv[2]}{k}.f-1.",))
"""
    for name in "abc":
        for k in range(20):
            _list_in(tmp_path, f"{name}{k}.f", name.encode())
    running = [
        subprocess.Popen(
            [sys.executable, "-c", code, str(tmp_path), name], stdin=subprocess.PIPE, text=True
        )
        for name in "abc"
    ]
    for process in running:
        process.communicate("go\n", timeout=300)
        assert process.returncode == 0
    checksums.remove_damaged(str(tmp_path))
    assert len(list(tmp_path.glob("*.nbc"))) == 60


@pytest.mark.skipif(sys.platform == "win32", reason="Windows limits no sizes of files")
def test_a_list_that_finds_no_room_leaves_nothing(tmp_path):
    _list_in(tmp_path, "a.f", b"compiled")
    code = """
import resource, sys
from iscat_analysis._kernels import checksums
resource.setrlimit(resource.RLIMIT_FSIZE, (10, 10))
checksums.record(sys.argv[1], ("a.f-1.",))
"""
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True)
    assert {path.name for path in tmp_path.iterdir()} == {"a.f-1.py311.1.nbc", "checksums.lock"}


@pytest.mark.skipif(sys.platform == "win32", reason="Windows limits no sizes of files")
def test_kernels_that_cannot_be_kept_for_want_of_room_end_no_run(tmp_path):
    full = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))\n"
    said, result, hits = supported(tmp_path, before=full)
    assert (result, hits) == ("True False", "0")
    assert said.startswith(f"compiled kernels cannot be kept in {tmp_path}")
    assert "File too large" in said
    assert not list(tmp_path.rglob("*.nb?"))  # that a later run could take


def test_kernels_are_kept_where_nothing_can_be_written(tmp_path):
    package = tmp_path / "iscat_analysis"
    shutil.copytree(
        Path(iscat_analysis.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__")
    )
    blocked = tmp_path / "file"
    blocked.write_text("a file is no folder, for whoever runs this", encoding="utf-8")
    (package / "_kernels" / "__pycache__").write_text("", encoding="utf-8")
    environment = {
        **{name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"},
        "PYTHONPATH": str(tmp_path),
        "HOME": str(blocked),
        "XDG_CACHE_HOME": str(blocked),
        "LOCALAPPDATA": str(blocked),
        "TMPDIR": str(tmp_path),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    code = """
import os, numpy as np
from iscat_analysis import _kernels
from iscat_analysis._kernels import checksums
from iscat_analysis._kernels.curvature import _weighted
assert _weighted(np.ones(4), np.ones(4)) == 4
folder = _kernels.environment()["NUMBA_CACHE_DIR"]
print(_kernels.TEMPORARY, folder, sum(len(files) for _, _, files in os.walk(folder)))
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    temporary, folder, files = done.stdout.split()
    assert temporary == "True"
    assert Path(folder).parent == tmp_path
    assert int(files) == 2  # an index, and what it names
    assert not Path(folder).exists()


def test_it_is_said_where_kernels_cannot_be_kept(monkeypatch):
    said = []
    with compiling(said.append):
        pass
    assert not said
    monkeypatch.setattr(_kernels, "TEMPORARY", True)
    with compiling(said.append):
        pass
    assert len(said) == 1
    assert "NUMBA_CACHE_DIR" in said[0]
