"""Compile, before tests and manual begin, the kernels that most of their processes need."""

from __future__ import annotations

import gc
import os
import sys
import tempfile
from pathlib import Path
from subprocess import Popen

ROOT = Path(__file__).resolve().parent.parent
ANOTHER = "another"

SMALL = ("simulation.shape=[64, 64]", "posterior.steps=100", "bounds.pixels=31")
FEW = ("simulation.count=6", "simulation.leavings=1", "simulation.frames=400")
ONE = ("simulation.events=[{frame=200, x_px=31.2, y_px=30.8, mass_kda=900.0}]",)
COMA = (*ONE, "optics.aberrations_nm.z8=10")
MOVING = (
    "simulation.count=0", "simulation.leavings=0", "simulation.frames=60",
    "simulation.movers=[{count=1, mass_kda=900.0, d_um2_s=0.15}]",
    "camera.frame_rate_hz=331.0", "fit.mode=track", "track.free=mass",
)  # fmt: skip


def compile_kernels() -> None:
    """Do small jobs of every kind, so that no two processes compile the same kernel later.

    What this leaves out is compiled where it is first needed.  Once the kernels that all jobs have
    in common are there, another process follows the particle that moves.
    """
    do_job("landing", FEW)
    with Popen([sys.executable, __file__, ANOTHER]) as another:
        for sample, changes in (("mass", ONE), ("mass", COMA), ("joint", ONE)):
            do_job(sample, changes)
        find_two_species()
    if another.returncode:
        raise RuntimeError(f"the particle that moves: status {another.returncode}")


def do_job(sample: str, changes: tuple[str, ...]) -> None:
    """Simulate a small movie like that of a sample configuration, analyse it, compute its bounds.

    No report is written: it has no kernels.
    """
    import iscat_analysis as ia

    path = ROOT / "sample_configs" / f"{sample}.toml"
    config = ia.configure(path, settings=(*SMALL, *changes))
    with tempfile.TemporaryDirectory() as folder:
        ia.simulate_movie(config, f"{folder}/movie.tif")
        ia.fit_movie(f"{folder}/movie.tif", config=config)
    ia.compute_bounds(config)


def find_two_species() -> None:
    """Find two species in eighty masses."""
    import pandas as pd

    import iscat_analysis as ia

    masses = [mass + 3.0 * (k % 11 - 5) for mass in (66, 146) for k in range(40)]
    ia.find_species(pd.DataFrame({"mass_kda": masses, "sigma_mass_kda": 8.0}))


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command does, not its function
    gc.disable()  # compilers leave few cycles, and to look for them takes a tenth of the time
    do_job("landing", MOVING) if sys.argv[1:] == [ANOTHER] else compile_kernels()
