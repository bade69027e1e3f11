"""Compiled kernels: what is said while they are made, by how many processes, and where they go."""

from __future__ import annotations

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
from iscat_analysis.config import load_config
from iscat_analysis.fitting import compilation as module
from iscat_analysis.fitting.compilation import Compilation, compiling, needs_of
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.inference.noise import compile_kernels
from iscat_analysis.optics.forward import forward_model

ROOM = "iscat_analysis._kernels"


def kernel(name: str) -> dict[str, SimpleNamespace]:
    """Give the data of the event of a function of a module that is compiled."""
    return {"dispatcher": SimpleNamespace(py_func=SimpleNamespace(__module__=name))}


@pytest.fixture
def started(monkeypatch):
    """Start processes that do nothing, and list them."""
    begun = []

    def start(self):
        begun.append(subprocess.Popen([sys.executable, "-c", "", *self.needs]))
        return begun[-1]

    monkeypatch.setattr(Compilation, "_started", start)
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
    with compiling(print, 2):
        with event.trigger_event("numba:compile", data=kernel("numpy")):
            assert not started
        for name in ("sliding", "drift", "image"):
            with event.trigger_event("numba:compile", data=kernel(f"{ROOM}.{name}")):
                assert len(started) == 1
    assert started[0].returncode is not None  # it ends with the first


def test_a_program_for_the_second_process_runs_nothing_of_the_folder_it_is_in(
    monkeypatch, tmp_path
):
    monkeypatch.setattr(sys, "platform", "another")
    ran = tmp_path / "ran"
    for name in ("numba.py", "iscat_analysis.py"):
        (tmp_path / name).write_text("open('ran', 'w').close()\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    other = Compilation(print, together=True, needs=())._started()
    with suppress(subprocess.TimeoutExpired):
        other.wait(timeout=5)  # long after its imports begin
    other.kill()
    other.wait()
    assert not ran.exists()
    subprocess.run(
        [sys.executable, "-m", module._REHEARSAL], stderr=subprocess.DEVNULL, check=False
    )
    assert ran.exists()


def test_the_second_process_ends_with_the_first(monkeypatch):
    command = [sys.executable, "-c", "import time; time.sleep(600)"]
    other = subprocess.Popen(command)
    monkeypatch.setattr(Compilation, "_started", lambda _: other)
    with (
        pytest.raises(KeyboardInterrupt),
        compiling(print, 2),
        event.trigger_event("numba:compile", data=kernel(f"{ROOM}.radial")),
    ):
        raise KeyboardInterrupt
    assert other.returncode not in (None, 0)


SHARED = """
import contextlib
import sys
import tempfile
from pathlib import Path

from iscat_analysis.config import load_config
from iscat_analysis._kernels import (
    canvas, curvature, diffusion, following, goodness, hessian, judging, moving, scan, scoring,
    sharing, sliding, stepping, well,
)
from iscat_analysis.fitting.compilation import needs_of
from iscat_analysis.pipeline.rehearsal import rehearse
from iscat_cli import main

names = (
    scoring.maximize, scan.scan_heights, hessian.signal_hessian, curvature.errors_and_bias,
    goodness.look, canvas.draw_frames, judging.judge_frames, moving.fit_frames,
    following.find_clusters, following.join_rows, following.follow_rows, sharing.own_shares,
    sharing.send, sharing.follow, diffusion.most_likely_diffusion, well.most_likely_well,
    stepping.part_sums, stepping.frame_scores, stepping.spreads, stepping.add_image,
    sliding.contrast_map, sliding.step_peaks, sliding.in_shadow, sliding.strongest_maps,
)
sample, *changes = sys.argv[1:]
rehearse(needs_of(load_config(Path(sample), changes)))
known = [set(kernel.signatures) for kernel in names]
print(sum(map(bool, known)))
with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(sys.stderr):
    options = ["--config", sample, *(f"--set={change}" for change in changes), "--quiet"]
    assert not main(["simulate", *options, "--out", f"{folder}/movie.tif"])
    assert not main(["fit", f"{folder}/movie.tif", *options])
for kernel, before in zip(names, known):
    if set(kernel.signatures) - before:
        print(kernel.py_func.__name__)
"""
FEW = ["simulation.shape=[64, 64]", "compute.workers=1", "posterior.enabled=false"]
REPEATS = {"frame_scores", "spreads"}  # which take 0.3 s
ONE = "simulation.events=[{frame=200, x_px=31.2, y_px=30.8, mass_kda=900.0}]"
MOVING = [
    "simulation.count=0", "simulation.leavings=0", "simulation.frames=60",
    "simulation.movers=[{count=2, mass_kda=900.0, d_um2_s=0.15}]", "camera.frame_rate_hz=331.0",
    "fit.mode=track",
]  # fmt: skip


@pytest.mark.parametrize(
    ("sample", "changes", "kernels", "more"),
    [
        ("mass", [ONE], 4, REPEATS),
        ("joint", [ONE], 4, {*REPEATS, "signal_hessian"}),  # at heights that are held fixed
        ("landing", ["simulation.frames=600"], 12, set()),
        ("landing", [*MOVING, "track.free=mass"], 12, set()),
    ],
)
def test_a_rehearsal_compiles_what_an_analysis_needs(sample, changes, kernels, more):
    done = subprocess.run(
        [sys.executable, "-c", SHARED, f"sample_configs/{sample}.toml", *FEW, *changes],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    known, *unknown = done.stdout.split()
    assert int(known) == kernels
    assert set(unknown) <= more


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
        ("landing", [], ("sliding",)),
        ("joint", [], ("heights",)),
        ("joint", ["posterior.enabled=true"], ("heights", "posteriors")),
        ("landing", ["fit.mode=track", "track.free=mass"], ("tracks",)),
        ("landing", ["fit.mode=track", "track.free=joint"], ("heights", "tracks")),
    ],
)
def test_an_analysis_compiles_what_it_needs(monkeypatch, sample, changes, parts):
    config = load_config(Path(f"sample_configs/{sample}.toml"), changes)
    assert needs_of(config) == parts
    run = set()
    for name, part in (("scan_heights", "heights"), ("values", "posteriors")):
        monkeypatch.setattr(Likelihood, name, lambda *_, part=part: run.add(part))
    free = []
    monkeypatch.setattr(Likelihood, "maximize", lambda *given, **_: free.append(given[2][2]))
    for backwards in (False, True):
        compile_kernels(forward_model(config, 2000.0), parts, backwards=backwards)
    assert run == set(parts) - {"tracks", "sliding"}
    assert free == 2 * ["heights" in parts]


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


SUPPORT = """
import numpy as np
from iscat_analysis._kernels.support import supported
from iscat_analysis.fitting.compilation import compiling

with compiling(print, 1):
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


@pytest.mark.parametrize(("suffix", "left"), [("nbi", 0.0), ("nbc", 0.5)])
def test_kept_kernels_that_are_cut_short_are_compiled_again(tmp_path, suffix, left):
    assert supported(tmp_path) == ["True False", "0"]
    for file in tmp_path.glob(f"*/*.{suffix}"):
        kept = file.read_bytes()
        file.write_bytes(kept[: int(len(kept) * left)])
    assert supported(tmp_path) == ["True False", "0"]
    assert supported(tmp_path) == ["True False", "1"]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows limits no sizes of files")
def test_kernels_that_cannot_be_kept_for_want_of_room_end_no_run(tmp_path):
    full = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))\n"
    result, hits, said = supported(tmp_path, before=full)
    assert (result, hits) == ("True False", "0")
    assert said.startswith(f"compiled kernels cannot be kept in {tmp_path}")
    assert "File too large" in said
    assert supported(tmp_path) == ["True False", "0"]


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
    assert int(files) == 3  # an index, what it names, and the claims
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
