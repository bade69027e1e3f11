"""Bounds: what no estimate can beat, as the microscope and the particle change."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import panel as pn

import iscat_analysis as ia
from iscat_analysis.report.numbers import parameter
from iscat_analysis.report.pictures import grey_png
from iscat_app.chosen import Chosen, Notice
from iscat_app.widgets import listing

_PIXELS = 61
_COLUMNS = (
    " | CRB, alone | CRB, together | QCRB",
    "{name} | {crb_single:.4g} | {crb_joint:.4g} | {qcrb:.4g}",
)
_SLIDERS = {
    "optics.na": ("NA", 0.8, 1.48, 0.01, 1.42),
    "optics.focus_nm": ("Focus [nm]", -1000, 1000, 10, -300),
    "optics.attenuation": ("Attenuation", 0.02, 1, 0.02, 1),
    "bounds.photons_per_pixel": ("Photoelectrons per pixel and frame", 1e3, 2e5, 1e3, 5e4),
    "bounds.n_after": ("Frames", 1, 1000, 1, 100),
    "particle.mass_kda": ("Mass [kDa]", 10, 2000, 5, 150),
    "particle.height_nm": ("Height [nm]", 0, 500, 5, 5),
}
"""Labels by key of the configuration, with first and last value, step, and the value at first."""


class Bounds:
    """The planner, and the classroom."""

    title = "Bounds"

    def __init__(self, chosen: Chosen) -> None:
        self._chosen = chosen
        self._notice = Notice()
        self._config: ia.Config | None = None
        self._seen = False
        self._sliders = {
            key: pn.widgets.FloatSlider(label=label, start=start, end=end, step=step, value=value)
            for key, (label, start, end, step, value) in _SLIDERS.items()
        }
        self._mode = pn.widgets.Select(
            label="Free", width=150, value="joint", options=["mass", "localize", "joint"]
        )
        self._picture = pn.pane.PNG(None, width=300, alt_text="what the camera sees of a particle")
        self._table, self._note = pn.pane.HTML(""), pn.pane.HTML("")
        self._notice.watch(self._follow, *self._sliders.values(), self._mode)
        self.body = pn.Column(
            self._notice.pane,
            pn.FlexBox(
                pn.Column(*self._sliders.values(), self._mode),
                pn.Column(self._table, self._note),
                self._picture,
            ),
        )

    def refresh(self) -> None:
        """Begin with the microscope of the chosen movie."""
        with self._notice.told():
            self._config = ia.configure(
                self._chosen.config, settings={"bounds.pixels": _PIXELS, "background.frames": None}
            )
        self._follow()

    def _follow(self) -> None:
        """Compute what the sliders say now: they move faster than that."""
        config, settings = self._config, self._settings()
        self._notice.latest(
            "" if self._seen else "Computing, the first time",
            lambda: _computed(config, settings),
            self._show,
        )

    def _settings(self) -> dict[str, Any]:
        settings: dict[str, Any] = {key: s.value for key, s in self._sliders.items()}
        settings["fit.mode"] = self._mode.value
        frames = int(settings["bounds.n_after"])
        settings |= {"bounds.n_after": frames, "bounds.n_before": frames}
        if self._config is None or self._config.camera.pixel_size_nm is None:
            settings["camera.pixel_size_nm"] = 84.4  # where nobody said
        return settings

    def _show(self, computed: tuple[ia.Bounds, np.ndarray[Any, Any], float]) -> None:
        found, image, took_s = computed
        self._seen = True
        most = float(np.abs(image).max()) or 1.0
        self._picture.object = grey_png((image / most + 1) / 2, _PIXELS)
        rows = [row | {"name": parameter(name)} for name, row in found.actual.T.to_dict().items()]
        self._table.object = listing(rows, *_COLUMNS)
        peak = 100 * image.flat[np.abs(image).argmax()]
        self._note.object = (
            f"<p>Peak contrast {peak:.3f} %. Standard deviations after all frames, with as many "
            f"before; pixels of {found.config.camera.pixel_size_nm:g} nm.</p>"
            f"<p><small>Computed in {1000 * took_s:.0f} ms.</small></p>"
        )


def _computed(
    config: ia.Config | None, settings: dict[str, Any]
) -> tuple[ia.Bounds, np.ndarray[Any, Any], float]:
    """Compute bounds and picture, and say how long that took."""
    began = time.perf_counter()
    found = ia.compute_bounds(config, settings=settings)
    setup = found.config
    particle = setup.optics, setup.particle, setup.camera
    image = ia.psf(*particle, pixels=_PIXELS, calibration=setup.calibration)
    return found, image, time.perf_counter() - began
