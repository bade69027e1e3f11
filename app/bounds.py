"""Bounds: what no estimate can beat, as the microscope and the particle change."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import panel as pn
from bokeh.models import ColumnDataSource, LinearColorMapper
from bokeh.palettes import gray
from bokeh.plotting import figure

import iscat_analysis as ia
from iscat_app.chosen import Chosen, Notice, table_of

_PIXELS = 61
_KINDS = {"crb_single": "CRB, alone", "crb_joint": "CRB, together", "qcrb": "QCRB"}
_KEYS = {"x_nm": "x [nm]", "y_nm": "y [nm]", "z_nm": "z [nm]", "mass_kda": "mass [kDa]"}


class Bounds:
    """The planner, and the classroom."""

    title = "Bounds"

    def __init__(self, chosen: Chosen) -> None:
        self._chosen = chosen
        self._notice = Notice()
        self._config: ia.Config | None = None
        self._seen = False
        slider = pn.widgets.FloatSlider
        self._sliders = {
            "optics.na": slider(label="NA", start=0.8, end=1.48, step=0.01, value=1.42),
            "optics.focus_nm": slider(
                label="Focus [nm]", start=-1000, end=1000, step=10, value=-300
            ),
            "optics.attenuation": slider(
                label="Attenuation", start=0.02, end=1, step=0.02, value=1
            ),
            "bounds.photons_per_pixel": slider(
                label="Photoelectrons per pixel and frame", start=1000, end=200_000, step=1000,
                value=50_000,
            ),
            "bounds.n_after": slider(label="Frames", start=1, end=1000, step=1, value=100),
            "particle.mass_kda": slider(label="Mass [kDa]", start=10, end=2000, step=5, value=150),
            "particle.height_nm": slider(label="Height [nm]", start=0, end=500, step=5, value=5),
        }  # fmt: skip
        self._mode = pn.widgets.Select(
            label="Free", width=150, value="joint", options=["mass", "localize", "joint"]
        )
        self._image = ColumnDataSource({"image": [np.zeros((_PIXELS, _PIXELS))]})
        self._mapper = LinearColorMapper(palette=gray(256), low=-1, high=1)
        plot = figure(width=380, height=380, tools="", toolbar_location=None,
                      title="What the camera sees of it")  # fmt: skip
        plot.image(image="image", x=0, y=0, dw=_PIXELS, dh=_PIXELS, source=self._image,
                   color_mapper=self._mapper)  # fmt: skip
        plot.y_range.flipped = True
        self._table = pn.pane.HTML("")
        self._note = pn.pane.HTML("")
        for widget in (*self._sliders.values(), self._mode):
            widget.param.watch(self._follow, "value")
        self.body = pn.Column(
            self._notice.pane,
            pn.FlexBox(
                pn.Column(*self._sliders.values(), self._mode),
                pn.Column(self._table, self._note),
                pn.pane.Bokeh(plot),
            ),
        )

    def refresh(self) -> None:
        """Begin with the microscope of the chosen movie."""
        with self._notice.told():
            self._config = ia.configure(
                self._chosen.config, settings={"bounds.pixels": _PIXELS, "background.frames": None}
            )
        self._follow()

    def _follow(self, *_: Any) -> None:
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
        self._mapper.update(low=-most, high=most)
        self._image.data = {"image": [image]}
        rows = [
            (_KEYS[str(name)], *(f"{row[kind]:.4g}" for kind in _KINDS))
            for name, row in found.actual.iterrows()
        ]
        self._table.object = table_of(rows, ("", *_KINDS.values()))
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
    image = ia.psf(
        found.config.optics, found.config.particle, found.config.camera, pixels=_PIXELS,
        calibration=found.config.calibration,
    )  # fmt: skip
    return found, image, time.perf_counter() - began
