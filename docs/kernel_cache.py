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
    import pandas as pd

    import iscat_analysis as ia

    small = ("simulation.shape=[64, 64]", "posterior.steps=100", "bounds.pixels=31")
    few = ("simulation.count=6", "simulation.leavings=1", "simulation.frames=400")
    one = ("simulation.events=[{frame=200, x_px=31.2, y_px=30.8, mass_kda=900.0}]",)
    cobri = (*one, "optics.scheme=cobri")
    coma = (*one, "optics.aberrations_nm.z8=10")
    moving = (
        "simulation.count=0", "simulation.leavings=0", "simulation.frames=60",
        "simulation.movers=[{count=1, mass_kda=900.0, d_um2_s=0.15}]",
        "camera.frame_rate_hz=331.0", "fit.mode=track", "track.free=mass",
    )  # fmt: skip
    jobs = [
        ("landing", few), ("landing", moving), ("mass", one), ("mass", coma), ("joint", one),
        ("joint", cobri),
    ]  # fmt: skip
    with tempfile.TemporaryDirectory() as name:
        for number, (sample, changes) in enumerate(jobs):
            movie = Path(name, f"{number}.tif")
            config = ia.configure(
                ROOT / "sample_configs" / f"{sample}.toml", settings=(*small, *changes)
            )
            ia.simulate_movie(config, movie)
            ia.fit_movie(movie, config=config)  # without the report, which has no kernels
            ia.compute_bounds(config)
    masses = [mass + 3.0 * (k % 11 - 5) for mass in (66, 146) for k in range(40)]
    ia.find_species(pd.DataFrame({"mass_kda": masses, "sigma_mass_kda": 8.0}))


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command does, not its function
    share_kernels(ROOT)
    compile_kernels()
