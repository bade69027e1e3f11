"""Images of a particle, and bounds of its estimates, for arrays of set-ups."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from iscat_analysis.bounds import event_bounds, quantum_bounds, quantum_information
from iscat_analysis.bounds.experiment import expected_likelihood
from iscat_analysis.config import CameraConfig, Optics, Particle
from iscat_analysis.errors import ConfigError
from iscat_analysis.inference.checks import number_in, truth_in
from iscat_analysis.inference.likelihood import LEVEL
from iscat_analysis.inference.models import TurningRod
from iscat_analysis.last_used import memoize
from iscat_analysis.optics.forward import ForwardModel, PixelGrid, forward_model
from iscat_analysis.optics.model import MassScale, collected_area_nm2, photons_per_intensity
from iscat_analysis.optics.scatterers import ANGLES, Rod
from iscat_analysis.options import takes
from iscat_analysis.pieces.counts import (
    LARGEST_REGION,
    BoundOptions,
    QuantumOptions,
    SquareOptions,
    config_of,
    darkfield_photons,
    together,
)
from iscat_analysis.records import PARAMETERS, FloatArray


@takes(SquareOptions)
def psf(
    optics: Optics, particle: Particle, camera: CameraConfig, **options: Unpack[SquareOptions]
) -> FloatArray:
    """Draw the image that a camera expects of a particle.

    Parameters
    ----------
    optics : Optics
        The microscope.
    particle : Particle
        Its material; its height sets the focus.
    camera : Camera
        Pixel size and samples per pixel.
    z_nm : array_like, optional
        Height above the coverslip [nm]; default ``particle.height_nm``.
    mass_kda : array_like, optional
        Mass [kDa]; default that of `particle`.
    calibration : Calibration, optional
        Contrast against mass, in place of the model's absolute scale.
    pixels : int
        Side of the square image [pixels].
    x_nm, y_nm : array_like
        Particle, from the centre of the image; x along columns, y down the rows [nm].

    Returns
    -------
    ndarray, shape (..., pixels, pixels)
        Contrast: light over the light without the particle, minus 1.  In dark field the scattered
        photoelectrons per pixel and frame.  The leading axes are those of the broadcast arguments.

    Raises
    ------
    ConfigError
        An argument is missing or impossible.
    DataError
        An argument does not hold real numbers.

    Notes
    -----
    Dong et al., J. Phys. D 54, 394002 (2021), section II, or with ``emission = "reciprocal"`` the
    wave that conserves energy.

    Examples
    --------
    >>> import numpy as np
    >>> import iscat_analysis as ia
    >>> optics = ia.Optics(na=1.42, wavelength_nm=525, focus_nm=-300)
    >>> protein, camera = ia.Particle(mass_kda=480), ia.Camera(pixel_size_nm=84.4)
    >>> ia.psf(optics, protein, camera, z_nm=np.linspace(0, 400, 5)).shape
    (5, 33, 33)
    """
    mode = "size" if isinstance(particle, Particle) and particle.is_sphere else "joint"
    config = config_of(optics, particle, camera, mode=mode, calibration=options["calibration"])
    side = int(number_in("pixels", options["pixels"], least=1, most=LARGEST_REGION, whole=True))
    pixel_nm = config.camera.pixel_nm
    z_nm, mass_kda = options["z_nm"], options["mass_kda"]
    given = {"x_nm": options["x_nm"], "y_nm": options["y_nm"]}
    given["z_nm"] = particle.nominal_height_nm if z_nm is None else z_nm
    nominal = forward_model(config, pixel_nm).material.mass_kda
    given["mass_kda"] = nominal if mass_kda is None else mass_kda
    at = together(given, least={"z_nm": 0.0})
    half = side * pixel_nm / 2
    reach = math.hypot(*(half + np.abs(at[name]).max(initial=0.0) for name in ("x_nm", "y_nm")))
    highest = max(float(at["z_nm"].max(initial=0.0)), particle.nominal_height_nm)
    model = forward_model(config, reach * 1.0001 + pixel_nm, z_max_nm=highest)
    unit = 1.0 if model.rho else photons_per_intensity(model, darkfield_photons(particle), pixel_nm)
    grid = PixelGrid.centred(side, pixel_nm)
    out = np.empty((*at["x_nm"].shape, side, side))
    for place in np.ndindex(at["x_nm"].shape):
        x, y, z, m = (float(at[name][place]) for name in ("x_nm", "y_nm", "z_nm", "mass_kda"))
        out[place] = unit * model.image(grid, x, y, z, m)
    return out


@takes(BoundOptions)
def crb(
    optics: Optics,
    particle: Particle,
    camera: CameraConfig,
    *,
    photons_per_pixel: ArrayLike,
    joint: bool = True,
    level: bool = False,
    **options: Unpack[BoundOptions],
) -> dict[str, FloatArray]:
    """Cramér–Rao bounds: the smallest standard deviations of unbiased estimates from such frames.

    Parameters
    ----------
    optics : Optics
        The microscope.
    particle : Particle
        Its material; its height sets the focus.
    camera : Camera
        Pixel size, samples per pixel and read noise.
    photons_per_pixel : array_like
        Background per pixel and frame [e]; in dark field it may be 0.
    joint : bool
        Whether all free parameters are unknown at once; False gives each with the others known.
        The angles of a rod are free in every mode.
    level : bool
        Whether the level of the light is unknown too.
    z_nm : array_like, optional
        Height above the coverslip [nm]; default ``particle.height_nm``.
    mass_kda : array_like, optional
        Mass [kDa]; default that of `particle`.
    calibration : Calibration, optional
        Contrast against mass, in place of the model's absolute scale.
    pixels : int
        Side of the square region [pixels].
    x_nm, y_nm : array_like
        Particle, from the centre of the region [nm].
    n_after : array_like
        Frames with the particle.
    mode : {"mass", "localize", "joint", "size"}
        Which parameters are free; ``"size"`` is for spheres, whose mass stands for the diameter.
    focus_nm : array_like, optional
        Focus [nm]; default ``optics.focus_nm``.
    n_before : array_like
        Frames of background; 0 where the background is known.

    Returns
    -------
    dict of str to ndarray
        Standard deviations [nm, kDa, degrees] of the free parameters, by name, each of the shape of
        the broadcast arguments; NaN where the image does not determine the parameter.

    Raises
    ------
    ConfigError
        An argument is missing or impossible.
    DataError
        An argument does not hold real numbers.

    Notes
    -----
    The inverse of the Fisher matrix of the likelihood that `fit_rois` maximises.

    Examples
    --------
    >>> import numpy as np
    >>> import iscat_analysis as ia
    >>> optics, camera = ia.Optics(na=1.42, focus_nm=-500), ia.Camera(pixel_size_nm=84.4)
    >>> gold = ia.Particle(kind="gold", diameter_nm=20)
    >>> bounds = ia.crb(optics, gold, camera, photons_per_pixel=1e4, n_after=100, mode="joint",
    ...                 z_nm=np.array([[50.0], [100.0]]), mass_kda=[10_000, 50_000, 90_000])
    >>> bounds["z_nm"].shape
    (2, 3)
    """
    given = {**options, "photons_per_pixel": photons_per_pixel}
    setups = _Setups(optics, particle, camera, given)
    joint, level = truth_in("joint", joint), truth_in("level", level)
    free = setups.free + (ANGLES if particle.is_rod else ())
    index = [(*PARAMETERS, *ANGLES).index(name) for name in free]
    read_noise_e = float(camera.assumed.read_noise_e)

    def bound(at: _At) -> FloatArray:
        frames = int(at.n_before), int(at.n_after)
        setup = at.model, setups.grid, at.theta, (at.level_e, at.scale_e), frames
        likelihood = expected_likelihood(*setup, read_noise_e=read_noise_e)
        rod = at.model.aperture.scatterer
        if isinstance(rod, Rod):
            every = np.insert(at.theta, LEVEL, [rod.azimuth_deg, rod.tilt_deg])
            of_rods = likelihood.under(TurningRod(at.model, rod))
            bounds = event_bounds(of_rods, every, free, level=level)
        else:
            bounds = event_bounds(likelihood, at.theta, free, at.collected, level=level)
        return (bounds.crb_joint if joint else bounds.crb_single)[index]

    return setups.bounds(free, bound)


@takes(QuantumOptions)
def qcrb(
    optics: Optics,
    particle: Particle,
    camera: CameraConfig,
    *,
    photons_per_pixel: ArrayLike,
    joint: bool = False,
    **options: Unpack[QuantumOptions],
) -> dict[str, FloatArray]:
    """Quantum Cramér–Rao bounds: the smallest standard deviations for any measurement of the light.

    Parameters
    ----------
    optics : Optics
        The microscope.
    particle : Particle
        Its material; its height sets the focus.  The direction of a rod is taken as known.
    camera : Camera
        Its pixel size turns photons per pixel into light.
    photons_per_pixel : array_like
        Background per pixel and frame [e]; it has no effect in dark field.
    joint : bool
        Whether all free parameters are unknown at once; by default each with the others known,
        since height and mass cannot both be measured so well.
    z_nm : array_like, optional
        Height above the coverslip [nm]; default ``particle.height_nm``.
    mass_kda : array_like, optional
        Mass [kDa]; default that of `particle`.
    calibration : Calibration, optional
        Contrast against mass, in place of the model's absolute scale.
    n_after : array_like
        Frames with the particle.
    mode : {"mass", "localize", "joint", "size"}
        Which parameters are free; ``"size"`` is for spheres, whose mass stands for the diameter.
    focus_nm : array_like, optional
        Focus [nm]; default ``optics.focus_nm``.

    Returns
    -------
    dict of str to ndarray
        As `crb` gives it.

    Raises
    ------
    ConfigError
        An argument is missing or impossible.
    DataError
        An argument does not hold real numbers.

    Examples
    --------
    >>> import iscat_analysis as ia
    >>> optics, camera = ia.Optics(na=1.42), ia.Camera(pixel_size_nm=84.4)
    >>> limit = ia.qcrb(optics, ia.Particle(mass_kda=480), camera, photons_per_pixel=[1e4, 4e4])
    >>> float(limit["x_nm"][0] / limit["x_nm"][1])
    2.0
    """
    given = {**options, "photons_per_pixel": photons_per_pixel}
    setups = _Setups(
        optics, particle, camera, {**given, "x_nm": 0.0, "y_nm": 0.0, "n_before": 0, "pixels": 2}
    )
    joint = truth_in("joint", joint)
    index = [PARAMETERS.index(name) for name in setups.free]
    is_mass = np.array(index) == PARAMETERS.index("mass_kda")

    def bound(at: _At) -> FloatArray:
        information = quantum_information(at.model, float(at.theta[2]))[np.ix_(index, index)]
        # photons are as a², and the information is of ln a: that of the mass is finite at a = 0
        amplitude = abs(float(at.theta[3]))
        shift = 1 / amplitude if amplitude else np.nan
        units = np.where(is_mass, abs(at.model.scale.slope(float(at.theta[3]))), shift)
        return np.asarray(quantum_bounds(information)[joint] * units / at.collected_per_a2**0.5)

    return setups.bounds(setups.free, bound)


@dataclass(frozen=True)
class _At:
    """One set-up: the model, where the particle is, and how much light there is."""

    model: ForwardModel
    theta: FloatArray
    level_e: float
    scale_e: float
    n_before: float
    n_after: float
    collected_per_a2: float

    @property
    def collected(self) -> float:
        """Scattered photons that the pupil collects."""
        return self.collected_per_a2 * float(self.theta[3]) ** 2


_LEAST = {"z_nm": 0.0, "photons_per_pixel": 0.0, "n_after": 1.0, "n_before": 0.0}


class _Setups:
    """Broadcast set-ups; models are shared between those of one focus."""

    def __init__(
        self, optics: Optics, particle: Particle, camera: CameraConfig, given: Mapping[str, Any]
    ) -> None:
        mode, line = given["mode"], given["calibration"]
        config = self._config = config_of(optics, particle, camera, mode=mode, calibration=line)
        self.free = config.fit.free
        side = number_in("pixels", given["pixels"], least=2, most=LARGEST_REGION, whole=True)
        self._pixel_nm = config.camera.pixel_nm
        self.grid = PixelGrid.centred(int(side), self._pixel_nm)
        self._dark = not config.optics.interferes
        # a calibration was measured at the focus of `optics`, not at the focus of the set-up
        nominal = forward_model(config, self._pixel_nm)
        self._scale = nominal.scale
        usual = {
            "z_nm": config.particle.nominal_height_nm,
            "mass_kda": nominal.material.mass_kda,
            "focus_nm": config.optics.focus_nm,
        }
        names = ("x_nm", "y_nm", "mass_kda", "focus_nm", *_LEAST)
        whole: dict[str, Any] = {k: usual.get(k) if given[k] is None else given[k] for k in names}
        self._all = together(whole, least=_LEAST)
        for name in ("n_after", "n_before"):
            broken = self._all[name] != np.round(self._all[name])
            if broken.any():
                raise ConfigError(
                    f"{name} = {self._all[name][broken].flat[0]:g}: give whole frames"
                )
        if not self._dark and np.any(self._all["photons_per_pixel"] == 0):
            raise ConfigError(
                "photons_per_pixel = 0: without background there is no interference; give the "
                'photoelectrons per pixel and frame, or Optics(scheme="darkfield")'
            )
        half = side * self._pixel_nm / 2
        for name in ("x_nm", "y_nm"):
            outside = np.abs(self._all[name]) > half
            if outside.any():
                raise ConfigError(
                    f"{name} = {self._all[name][outside].flat[0]:g} lies outside the region of "
                    f"±{half:g} nm: move the particle, or enlarge pixels = {side:g}"
                )
        self.shape = self._all["x_nm"].shape
        far = [half + float(np.abs(self._all[name]).max(initial=0.0)) for name in ("x_nm", "y_nm")]
        self._reach_nm = math.hypot(*far) * 1.0001
        highest = float(self._all["z_nm"].max(initial=0.0))
        self._highest_nm = max(highest, config.particle.nominal_height_nm)
        self._model = memoize(64, self._at_focus)

    def bounds(
        self, free: Sequence[str], bound: Callable[[_At], FloatArray]
    ) -> dict[str, FloatArray]:
        """Give the bounds of the free parameters by name, of every set-up."""
        out = np.full((len(free), *self.shape), np.nan)
        for place in np.ndindex(self.shape):
            out[(slice(None), *place)] = bound(self.at(place))
        return {name: np.asarray(values) for name, values in zip(free, out, strict=True)}

    def at(self, place: tuple[int, ...]) -> _At:
        """Give the set-up at an index."""
        now = {name: float(values[place]) for name, values in self._all.items()}
        model = self._model(now["focus_nm"])
        amplitude = model.scale.amplitude(now["mass_kda"])
        theta = np.array([now["x_nm"], now["y_nm"], now["z_nm"], amplitude, 0.0])
        level_e = scale_e = now["photons_per_pixel"]
        if self._dark:
            photons = darkfield_photons(self._config.particle)
            scale_e = photons_per_intensity(model, photons, self._pixel_nm)
        unit = replace(model, scale=MassScale())  # whose mass is the amplitude
        area = collected_area_nm2(unit, now["z_nm"], 1.0) / self._pixel_nm**2
        light = now["n_after"] * scale_e * area
        return _At(model, theta, level_e, scale_e, now["n_before"], now["n_after"], light)

    def _at_focus(self, focus_nm: float) -> ForwardModel:
        config = self._config.changed(optics={"focus_nm": focus_nm}, calibration=None)
        model = forward_model(config, self._reach_nm, z_max_nm=self._highest_nm)
        return replace(model, scale=self._scale)
