"""Pixels integrate over their area: against means over many points, and fits of such light."""

from __future__ import annotations

import io
import math
from typing import Any

import numpy as np
import pytest

import iscat_analysis as ia
from iscat_analysis.config import Config, parse_config
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.forward import ForwardModel, PixelGrid, forward_model
from iscat_analysis.optics.pixels import TOLERANCE, PixelArea
from iscat_analysis.optics.waves import Template

GRADIENT = -3.1e-5  # per kDa, of the peak contrast, as theory would give it
FINE, SHARES = np.polynomial.legendre.leggauss(16)  # exact to 1e-12 in any pixel here
SCHEMES = {"iscat": -300.0, "cobri": 0.0, "darkfield": 0.0}
STANDARD_ERRORS = 2.5


def _config(pixel_nm: float, scheme: str = "iscat", **camera: Any) -> Config:
    return parse_config(
        {
            "optics": {"scheme": scheme, "focus_nm": SCHEMES[scheme]},
            "camera": {
                "pixel_size_nm": pixel_nm, "gain_e_per_adu": 1.0, "offset_adu": 0.0,
                "read_noise_e": 0.0, **camera,
            },
            "particle": {"kind": "protein", "mass_kda": 1000.0},
        }
    )  # fmt: skip


def _mean(
    model: ForwardModel, grid: PixelGrid, place: tuple[float, float], mass: float, side: float = 1.0
) -> np.ndarray:
    """Mean of the light at many points in every pixel, over that of the reference."""
    inside = side * grid.pixel_nm / 2 * FINE
    x, y = ((axis[:, None] + inside).ravel() - at for axis, at in
            zip((grid.x_nm, grid.y_nm), place, strict=True))  # fmt: skip
    field = model.field(*np.meshgrid(x, y), model.height_nm, mass)
    light = 2 * model.rho * field[0].real + np.sum(np.abs(field) ** 2, axis=0)
    rows, columns = grid.shape
    light = light.reshape(rows, FINE.size, columns, FINE.size)
    return np.asarray(np.einsum("yixj,i,j->yx", light, SHARES / 2, SHARES / 2))


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("pixel_nm", [20.0, 60.0, 84.0, 120.0, 250.0])
def test_pixels_integrate_by_default(pixel_nm: float, scheme: str) -> None:
    config = _config(pixel_nm, scheme)
    grid = PixelGrid.centred(2 * int(500 / pixel_nm) + 1, pixel_nm)
    model = forward_model(config, 2 * grid.diagonal_nm)
    place = (0.13 * pixel_nm, -0.31 * pixel_nm)
    wanted = _mean(model, grid, place, 1.0)
    found = model.image(grid, *place, model.height_nm, 1.0)
    largest = np.abs(wanted).max()
    assert np.abs(found - wanted).max() < 2 * TOLERANCE * largest
    points = forward_model(_config(pixel_nm, scheme, samples_per_pixel=1), model.reach_nm)
    other = points.image(grid, *place, model.height_nm, 1.0)
    assert np.abs(other - wanted).max() > 10 * TOLERANCE * largest


def test_only_the_active_area_counts() -> None:
    grid = PixelGrid.centred(9, 120.0)
    for share in (0.25, 0.6):
        model = forward_model(_config(120.0, fill_factor=share), 2 * grid.diagonal_nm)
        wanted = _mean(model, grid, (11.0, -23.0), 1.0, math.sqrt(share))
        found = model.image(grid, 11.0, -23.0, model.height_nm, 1.0)
        assert np.abs(found - wanted).max() < 2 * TOLERANCE * np.abs(wanted).max()
    with pytest.raises(ConfigError, match="fill_factor"):
        _config(120.0, fill_factor=0.0)


def test_there_are_as_few_points_as_the_light_needs() -> None:
    """Each number reaches as far as its error allows, and one less would exceed it."""
    last = 0
    for pixel_nm in np.geomspace(1.0, 400.0, 60):
        offsets, weights = PixelArea.of(*_camera(pixel_nm)).points(pixel_nm)
        assert weights.sum() == pytest.approx(1.0, abs=1e-12)
        waves = np.linspace(0.0, 2 * np.pi / 525.0 * 1.5, 500)  # of the largest aperture
        box = np.sinc(waves * pixel_nm / 2 / np.pi)
        assert np.abs(weights @ np.cos(np.outer(offsets, waves)) - box).max() < 1.01 * TOLERANCE
        fewer, share = np.polynomial.legendre.leggauss(max(offsets.size - 1, 1))
        worse = share / 2 @ np.cos(np.outer(fewer * pixel_nm / 2, waves)) - box
        assert offsets.size == 1 or np.abs(worse).max() > TOLERANCE
        assert offsets.size >= last
        last = offsets.size
    assert last == 5


def _camera(pixel_nm: float) -> tuple[Any, Any]:
    config = _config(pixel_nm)
    return config.camera, config.optics


def test_the_papers_convention_samples_the_centres() -> None:
    config = _config(84.0)
    optics = config.optics.model_copy(update={"convention": "dong2021"})
    assert PixelArea.of(config.camera, optics).points(84.0)[0].tolist() == [0.0]


class _Regions:
    """Particles of known masses in light that pixels integrate, drawn without the program's model.

    Their peak contrast per mass is known, as from theory: it is that of the field, between pixels.
    """

    def __init__(self, pixel_nm: float, seed: int, count: int = 60) -> None:
        random = np.random.default_rng(seed)
        self.config = _config(pixel_nm)
        self.pixel_nm, side = pixel_nm, 2 * round(1300 / pixel_nm) + 1
        grid = PixelGrid.centred(side, pixel_nm)
        model = forward_model(self.config, 2 * grid.diagonal_nm)
        self.masses = random.uniform(200.0, 2000.0, count)
        light, frames = 1e5, 50
        self.frames = frames
        signals = []
        for mass in self.masses:
            amplitude = 1.0  # of the field that has the peak contrast of this mass
            for _ in range(8):
                amplitude *= GRADIENT * mass / model.peak_contrast(model.height_nm, amplitude)
            place = tuple(random.uniform(-0.5, 0.5, 2) * pixel_nm)
            signals.append(_mean(model, grid, place, amplitude))
        expected = light * frames * (1 + np.array(signals))
        self.before = random.poisson(light * frames, expected.shape).astype(float)
        self.after = random.poisson(expected).astype(float)

    def fits(self, gradient: float = GRADIENT, **camera: Any) -> Any:
        """Fit all of them."""
        config = self.config
        return ia.fit_rois(
            self.before, self.after, config.optics, config.particle,
            config.camera.model_copy(update=camera), n_before=self.frames, n_after=self.frames,
            power_ratio=1.0, calibration=ia.Calibration(gradient_per_kda=gradient),
        )  # fmt: skip

    def bias(self, found: Any) -> tuple[float, float]:
        """Mean relative error of the masses, weighted, and its standard error."""
        weight = (self.masses / found["sigma_mass_kda"].to_numpy()) ** 2
        error = found["mass_kda"].to_numpy() / self.masses - 1
        return float(np.sum(weight * error) / np.sum(weight)), float(np.sum(weight) ** -0.5)


@pytest.mark.parametrize(("pixel_nm", "lost"), [(84.0, 0.048), (120.0, 0.092)])
def test_masses_are_right_where_the_gradient_is_known(pixel_nm: float, lost: float) -> None:
    """By points at the centres of pixels, masses were 4.8 and 9 % too small, and called ok."""
    regions = _Regions(pixel_nm, 7)
    found = regions.fits()
    mean, error = regions.bias(found)
    assert error < 0.002
    assert abs(mean) < STANDARD_ERRORS * error
    assert (found["status"] == "ok").all()
    points, error = regions.bias(regions.fits(samples_per_pixel=1))
    assert points == pytest.approx(-lost, abs=0.005)


def test_masses_by_standards_do_not_change() -> None:
    """A line measured with the same model has the same share of the contrast missing."""
    regions, masses = _Regions(84.0, 8, count=12), {}
    for samples in ("auto", 1):
        fits = regions.fits(samples_per_pixel=samples)
        contrast, sizes = fits["contrast"].to_numpy(), regions.masses
        gradient = float(np.sum(contrast * sizes) / np.sum(sizes**2))
        masses[samples] = regions.fits(gradient, samples_per_pixel=samples)["mass_kda"].to_numpy()
    assert np.abs(masses["auto"] / masses[1] - 1).max() < 2e-3


def test_pixels_are_those_of_the_standards() -> None:
    """A calibration of an earlier version, whose model took points, is used with points."""
    line: dict[str, Any] = {"gradient_per_kda": GRADIENT}
    for stored, given, used in (
        (None, "auto", "auto"), ({"pixel_size_nm": 84.0}, "auto", 1),
        ({"samples_per_pixel": 3}, "auto", 3), ({"samples_per_pixel": "auto"}, "auto", "auto"),
        ({"samples_per_pixel": 1}, 2, 2),
    ):  # fmt: skip
        calibration = line if stored is None else {**line, "camera": stored}
        config = parse_config({"camera": {"samples_per_pixel": given}, "calibration": calibration})
        assert config.camera.samples_per_pixel == used


def test_templates_of_earlier_versions_have_their_pixels_in_them(tmp_path: Any) -> None:
    template = Template(np.eye(9), np.eye(9), 40.0, 84.4, 160.0, 0.1, 5)
    path = tmp_path / "template.npz"
    path.write_bytes(template.to_bytes())
    assert Template.read(path).side == 1.0
    with np.load(io.BytesIO(template.to_bytes())) as stored:
        np.savez(path, **{key: stored[key] for key in stored.files if key != "side"})
    assert Template.read(path).side == 0.0
