"""Draw the figure of microscope.md: the same particles before and after the optics are learned.

python docs/howto/microscope_figure.py

It simulates the page's movie, learns its optics, and averages the particles twice: fitted with the
configured optics, and with the learned optics.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

import iscat_analysis as ia
from iscat_analysis.instrument.joint_fit import maximise
from iscat_analysis.instrument.particle_image import microscopes, reach_nm, with_masses
from iscat_analysis.instrument.result import Pictures, make_pictures
from iscat_analysis.optics.parameters import settings_of

HERE = Path(__file__).resolve().parent
CONFIG = HERE.parent / "tutorial.toml"
TRUE = {
    "optics.focus_nm": -360,
    "optics.polarization": "circular",
    "optics.aberrations_nm.z8": -10,
    "optics.aberrations_nm.z11": 15,
}
"""Differences of the movie's optics from the configuration."""

STYLE = {"font.size": 9, "svg.fonttype": "none", "svg.hashsalt": "microscope"}
RANGE = 6.0  # standard deviations


def before_and_after() -> tuple[Pictures, Pictures]:
    """Average the same particles, fitted with the configured optics and with the learned ones."""
    with tempfile.TemporaryDirectory() as folder:
        movie = Path(folder) / "mine.tif"
        ia.simulate_movie(CONFIG, movie, settings=TRUE)
        found = ia.calibrate_optics(movie, config=CONFIG)
    config = ia.configure(CONFIG)
    images = found.measured.estimate.images
    build = microscopes(config, max(map(reach_nm, images)))
    configured = settings_of(config)
    fitted = maximise(with_masses(images, build, configured), build, configured, ())
    return make_pictures(fitted.images, build, configured), found.pictures


def draw(rows: Sequence[tuple[str, Pictures]]) -> Figure:
    """Draw measured picture, model and residual of each row."""
    figure = Figure(figsize=(6.6, 3.9), layout="constrained")
    panels = figure.subplots(len(rows), 3)
    largest = max(np.abs(pictures.measured).max() for _, pictures in rows)
    for line, (name, pictures) in zip(panels, rows, strict=True):
        half = pictures.measured.shape[0] * pictures.pixel_nm / 2000
        extent = (-half, half, half, -half)
        for axes, image in zip(line[:2], (pictures.measured, pictures.model), strict=True):
            shown = axes.imshow(
                100 * image, cmap="RdBu_r", vmin=-100 * largest, vmax=100 * largest, extent=extent
            )
        left_over = line[2].imshow(
            pictures.residual, cmap="PuOr_r", vmin=-RANGE, vmax=RANGE, extent=extent
        )
        figure.colorbar(shown, ax=line[1], label="contrast [%]", shrink=0.7)
        figure.colorbar(left_over, ax=line[2], label="residual [σ]", shrink=0.7)
        rms = float(np.sqrt(np.mean(pictures.residual**2)))
        line[0].set_ylabel(f"{name}\ny [µm]")
        line[2].set_title(f"residual, rms {rms:.1f} σ", fontsize=9)
    for axes, title in zip(panels[0], ("measured", "model"), strict=False):
        axes.set_title(title, fontsize=9)
    for axes in panels[-1]:
        axes.set_xlabel("x [µm]")
    return figure


def main() -> None:
    """Write the figure."""
    configured, learned = before_and_after()
    with mpl.rc_context(STYLE):
        figure = draw([("as configured", configured), ("learned", learned)])
        figure.savefig(HERE / "figures" / "microscope.png", dpi=200)


if __name__ == "__main__":
    main()
