"""One folder of compiled kernels for the tests, the manual, and every process that they start."""

from __future__ import annotations

import os
import tempfile
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def share_kernels(root: Path) -> None:
    """Name the folder in the environment, unless it is named there.

    Kernels that were compiled with one version of NumPy or Numba do not serve another.

    Parameters
    ----------
    root : Path
        The checkout.
    """
    names = (f"{name}-{version(name)}" for name in ("numba", "numpy"))
    os.environ.setdefault("NUMBA_CACHE_DIR", str(root / ".kernels" / "_".join(names)))


def compile_kernels() -> None:
    """Do small jobs of every kind, so that no two processes compile the same kernel later.

    What this leaves out is compiled where it is first needed.
    """
    from iscat_cli import main

    samples = ROOT / "sample_configs"
    small = ("simulation.shape=[64, 64]", "posterior.steps=100", "bounds.pixels=31")
    few = ("simulation.count=6", "simulation.leavings=1", "simulation.frames=400")
    one = ("simulation.events=[{frame=200, x_px=31.2, y_px=30.8, mass_kda=900.0}]",)
    jobs = [("landing", "mass", few), ("mass", "mass", one), ("joint", "joint", one)]
    jobs += [("joint", "joint", (*one, f"optics.scheme={s}")) for s in ("cobri",)]
    with tempfile.TemporaryDirectory() as name:
        for number, (sample, mode, changes) in enumerate(jobs):
            movie = f"{name}/{number}.tif"
            options = ["--config", str(samples / f"{sample}.toml"), "--quiet"]
            options += [f"--set={change}" for change in (*small, *changes)]
            main(["simulate", *options, "--out", movie])
            main(["fit", movie, *options, "--mode", mode])
            main(["bounds", *options, "--mode", mode])


if __name__ == "__main__":
    share_kernels(ROOT)
    compile_kernels()
