"""Compiled kernels: what is said while they are made, by how many processes, and where they go."""

from __future__ import annotations

import gc
import os
import shutil
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import pytest
from numba.core import event

import iscat_analysis
from iscat_analysis import _kernels
from iscat_analysis._kernels.goodness import look
from iscat_analysis._kernels.hessian import signal_hessian
from iscat_analysis._kernels.scan import scan_heights
from iscat_analysis._kernels.scoring import maximize, value_batch
from iscat_analysis.config import load_config
from iscat_analysis.inference import ahead
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.inference.noise import (
    PARTS,
    compile_kernels,
    compile_maximisation,
    compile_values,
)
from iscat_analysis.optics.forward import forward_model
from iscat_analysis.pipeline import compilation as module
from iscat_analysis.pipeline.compilation import compiling, needed_parts

ROOM = "iscat_analysis._kernels"


def kernel(name: str) -> dict[str, SimpleNamespace]:
    """Give the data of the event of a function of a module that is compiled."""
    return {"dispatcher": SimpleNamespace(py_func=SimpleNamespace(__module__=name))}


@pytest.fixture
def started(monkeypatch):
    """Start processes that do nothing, and list them."""
    begun = []

    def start(parts):
        begun.append(subprocess.Popen([sys.executable, "-c", "", *parts]))
        return begun[-1]

    monkeypatch.setattr(module, "_started", start)
    return begun


def test_compilation_is_announced_once_and_its_stages_are_named(monkeypatch, started):
    monkeypatch.setattr(module, "_PATIENCE_S", 0.0)
    monkeypatch.setattr(module, "_BETWEEN_S", 0.0)
    said = []
    with compiling(said.append, 1):
        with event.trigger_event("numba:compile", data=kernel(f"{ROOM}.radial")):
            while not said:
                time.sleep(0.001)
            with event.trigger_event("numba:compile", data=kernel("numba.np.arrayobj")):
                pass
        for _ in range(2):
            with event.trigger_event("numba:compile", data=kernel(f"{ROOM}.scoring")):
                pass
    with event.trigger_event("numba:compile", data=kernel(f"{ROOM}.moving")):
        pass
    assert said == [
        "compiling the numerical kernels, once per installation: the tables of the microscope…",
        "still compiling: fits…",
    ]
    assert not started


def test_nothing_is_said_of_a_kernel_that_is_quick(monkeypatch):
    monkeypatch.setattr(module, "_PATIENCE_S", 0.05)
    said = []
    with compiling(said.append, 1) as compilation:
        with event.trigger_event("numba:compile", data=kernel(f"{ROOM}.sliding")):
            pass
        compilation._timer.join()
    assert not said


def test_a_second_process_is_started_once_for_the_first_kernel(started):
    with compiling(print, 2) as compilation:
        with event.trigger_event("numba:compile", data=kernel("numpy")):
            assert not started
        for name in ("sliding", "drift", "image"):
            with event.trigger_event("numba:compile", data=kernel(f"{ROOM}.{name}")):
                assert len(started) == 1
        compilation.wait()
        assert started[0].returncode == 0


def test_the_second_process_runs_nothing_of_the_folder_it_is_in(monkeypatch, tmp_path):
    ran = tmp_path / "ran"
    for name in ("numba.py", "iscat_analysis.py"):
        (tmp_path / name).write_text("open('ran', 'w').close()\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    other = module._started(())
    with suppress(subprocess.TimeoutExpired):
        other.wait(timeout=5)  # long after its imports begin
    other.kill()
    other.wait()
    assert not ran.exists()
    subprocess.run(
        [sys.executable, "-m", "iscat_analysis.inference.ahead"],
        stderr=subprocess.DEVNULL,
        check=False,
    )
    assert ran.exists()


def test_the_second_process_ends_with_the_first(monkeypatch):
    command = [sys.executable, "-c", "import time; time.sleep(600)"]
    other = subprocess.Popen(command)
    monkeypatch.setattr(module, "_started", lambda _: other)
    with (
        pytest.raises(KeyboardInterrupt),
        compiling(print, 2),
        event.trigger_event("numba:compile", data=kernel(f"{ROOM}.radial")),
    ):
        raise KeyboardInterrupt
    assert other.returncode not in (None, 0)


def test_the_second_process_compiles_what_the_first_needs():
    shared = (value_batch, signal_hessian, scan_heights, look)
    others = set(maximize.signatures)  # of other tests
    ahead.main(PARTS)
    assert gc.isenabled()  # only a process that is short does without
    made = [set(kernel.signatures) for kernel in shared]
    assert all(made)
    config = load_config(Path("sample_configs/joint.toml"), [])
    compile_kernels(forward_model(config, 2000.0))
    assert [set(kernel.signatures) for kernel in shared] == made
    assert len(set(maximize.signatures) - others) <= 2  # of the field, and of a picture


def test_a_kernel_of_the_second_process_is_awaited_and_not_compiled_twice(monkeypatch, tmp_path):
    monkeypatch.setattr(_kernels.config, "CACHE_DIR", str(tmp_path))

    def third(x):
        return x / 3

    third.__module__ = f"{ROOM}.residuals"
    here, there = _kernels.kernel()(third), _kernels.kernel()(third)
    with _kernels.awaited(["residuals"], lambda: None):
        assert here(3.0) == 1.0
    assert sum(here.stats.cache_misses.values()) == 1  # the other one has ended without it

    def wait():
        with monkeypatch.context() as own:
            own.setattr(_kernels, "_elsewhere", {})
            there(1)

    with _kernels.awaited(["residuals"], wait):
        assert here(6) == 2.0
    assert list(here.stats.cache_hits.values()) == [1]
    assert sum(here.stats.cache_misses.values()) == 1


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


@pytest.mark.parametrize(
    ("sample", "changes", "parts"),
    [
        ("mass", [], ("posteriors",)),
        ("mass", ["posterior.enabled=false"], ()),
        ("landing", [], ()),
        ("joint", [], ("heights",)),
        ("joint", ["posterior.enabled=true"], ("heights", "posteriors")),
    ],
)
def test_an_analysis_compiles_what_it_needs(monkeypatch, sample, changes, parts):
    config = load_config(Path(f"sample_configs/{sample}.toml"), changes)
    assert needed_parts(config) == parts
    run = set()
    for name, part in (("scan_heights", "heights"), ("values", "posteriors")):
        monkeypatch.setattr(Likelihood, name, lambda *_, part=part: run.add(part))
    compile_values(forward_model(config, 2000.0), parts)
    assert run == set(parts)
    free = []
    monkeypatch.setattr(Likelihood, "maximize", lambda *given, **_: free.append(given[2][2]))
    compile_maximisation(forward_model(config, 2000.0), parts)
    assert any(free) == ("heights" in parts)


def test_a_kept_kernel_is_loaded_without_what_compiling_needs(tmp_path):
    script = (
        "import sys, numpy as np\n"
        "from iscat_analysis._kernels.support import supported\n"
        "edge = np.array([-100.0, 100.0])\n"
        "places = np.array([[0, 0, 50, 1, 0], [900, 0, 50, 1, 0]], dtype=float)\n"
        "print(*supported(places, edge, edge, 5.0, 500.0, 0.0, 100.0, 1.0))\n"
        "print('numba.cpython.setobj' in sys.modules)\n"
    )
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    said = [
        subprocess.run(
            [sys.executable, "-c", script],
            env=environment, capture_output=True, text=True, check=True,
        ).stdout.split()
        for _ in range(2)
    ]  # fmt: skip
    assert said == [["True", "False", "True"], ["True", "False", "False"]]


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
    assert int(files) == 2
    assert not Path(folder).exists()


def test_it_is_said_where_kernels_cannot_be_kept(monkeypatch):
    said = []
    with compiling(said.append, 1):
        pass
    assert not said
    monkeypatch.setattr(_kernels, "TEMPORARY", True)
    with compiling(said.append, 1):
        pass
    assert len(said) == 1
    assert "NUMBA_CACHE_DIR" in said[0]
