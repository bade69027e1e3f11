"""What an uncertain microscope leaves in every particle: errors that all events share.

The likelihood of one particle has unknowns of its own, θ = (x, y, z, mass, level), and those of the
microscope, p.  If p is off by δp, the estimate of θ moves by D δp with D = −I_θθ⁻¹ I_θp: what the
particle does to imitate the change of the picture.  A covariance Σ of the microscope becomes
D Σ Dᵀ.  The same blocks say what the particle tells of the microscope once its own unknowns are
fitted, I_pp − I_pθ I_θθ⁻¹ I_θp.

`forecast_optics` says how well particles would tell the microscope, before they are recorded.  The
information that each expected picture holds about the optics, once the particle's own place,
mass and level are fitted, adds up over the pictures, with that of the prior; the inverse of the sum
is the covariance that `iscat calibrate optics` will report.  What it leaves in the masses and
heights of later fits follows from `iscat_analysis.bounds.shared`.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.bounds.classical import event_bounds
from iscat_analysis.bounds.experiment import detector, expected_likelihood, picked
from iscat_analysis.config import Config, refuse_rod
from iscat_analysis.errors import ConfigError
from iscat_analysis.findings import Finding
from iscat_analysis.findings.setup import FAINT_PICTURES, PICTURES_LEFT_OUT
from iscat_analysis.inference.checks import number_in
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.inference.maximiser import eliminated, imitation
from iscat_analysis.optics.forward import PEAK_SEARCH_RADIUS, ForwardModel, PixelGrid, forward_model
from iscat_analysis.optics.parameters import (
    FAINTEST,
    FREE,
    MOST_IMAGES,
    are_told,
    exists,
    free_groups,
    prior_of,
    settings_of,
)
from iscat_analysis.records import FREE_PARAMETERS, PARAMETERS, FloatArray
from iscat_analysis.text import brief
from iscat_analysis.threads import one_thread_algebra

_PEAK_POINTS = 61  # per axis, of the grid on which the peak of a contrast is looked for
_PEAK_NM = 0.1  # to which it is found


def joint_information(
    likelihood: Likelihood,
    theta: FloatArray,
    names: Sequence[str],
    others: Sequence[FloatArray] = (),
) -> FloatArray:
    """Fisher information of one particle about the microscope and about itself.

    `others` are derivatives of the signal with respect to further parameters, which come first;
    n is their number, that of the names, and 5.

    Shapes: `theta` (5,), `others` (ny, nx) each, result (n, n).
    """
    model, grid = likelihood.model, likelihood.grid
    signal, own = model.signal(grid, theta[:4])  # without names, since lattices err by 1e-7
    shared = model.signal(grid, theta[:4], names)[1][4:] if names else ()
    ordered = np.array([*others, *shared, *own])
    return likelihood.score_of_signal(signal, ordered, float(theta[4]))[2]


def displacement(
    likelihood: Likelihood,
    theta: FloatArray,
    names: Sequence[str],
    free: Sequence[str],
    *,
    level: bool = True,
) -> FloatArray:
    """Change of the estimates of a particle with the assumed microscope.

    Shapes: `theta` (5,), result (len(free).
    """
    whole = joint_information(likelihood, theta, names)
    count = len(names)
    own = [PARAMETERS.index(name) for name in free]
    kept = [*range(count), *(count + i for i in own), *([count + 4] if level else [])]
    moves = imitation(whole[np.ix_(kept, kept)], count)[: len(own)]
    if "mass_kda" in free:
        row, model = list(free).index("mass_kda"), likelihood.model
        moves[row] *= model.scale.slope(float(theta[3]))
        moves[row] += mass_drift(model, float(theta[3]), names)
    return moves


def mass_drift(model: ForwardModel, amplitude: float, names: Sequence[str]) -> FloatArray:
    """Change of the mass that a calibration gives an amplitude, with the microscope.

    A line that keeps the optics of its standards gives an amplitude one mass in any microscope.

    Shapes: result (len(names).
    """
    line = model.scale.calibration
    if line is None or line.optics is not None or not names:
        return np.zeros(len(names))
    *_, slopes = peak_gradient(model, model.height_nm, amplitude, names)
    return np.asarray(slopes / line.gradient_per_kda)


def peak_gradient(
    model: ForwardModel, z_nm: float, amplitude: float, names: Sequence[str]
) -> tuple[float, FloatArray, FloatArray]:
    """Peak contrast, and how it changes with the particle and with the microscope.

    Shapes: `own` (4,), `shared` (len(names).
    """
    spot = model.optics.wavelength_nm / model.optics.na
    x, y, half = 0.0, 0.0, min(PEAK_SEARCH_RADIUS * spot, model.reach_nm - spot) / math.sqrt(2)
    while half > _PEAK_NM:
        axis = np.linspace(-half, half, _PEAK_POINTS)
        grid = PixelGrid(x + axis, y + axis, _PEAK_NM)
        signal = np.abs(model.amplitude_image(grid, 0.0, 0.0, z_nm, amplitude))
        row, column = np.unravel_index(int(np.argmax(signal)), signal.shape)
        x, y = float(grid.x_nm[column]), float(grid.y_nm[row])
        half *= 3 / _PEAK_POINTS
    # where the signal is largest its place does not matter to first order
    there = PixelGrid(np.array([x]), np.array([y]), _PEAK_NM)
    at = (0.0, 0.0, z_nm, amplitude)
    contrast, slopes = model.signal(there, at, names)
    return float(contrast[0, 0]), slopes[:4, 0, 0], slopes[4:, 0, 0]


def shared_sigma(moves: FloatArray, covariance: FloatArray) -> FloatArray:
    """Give the standard deviations that an uncertain microscope puts into all particles alike.

    Shapes: `moves` (k, n), `covariance` (n, n), result (k,).
    """
    variance = np.einsum("ki,ij,kj->k", moves, covariance, moves)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


EVENTS = 60
"""Particles where nobody says how many."""

GOALS = (("focus_nm", 5.0), ("mass_rel", 0.01))
"""Precisions whose price is told: of the focus [nm], and the common relative error of masses."""

FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Masses, over the configured one, for which it is told."""

MODES = ("mass", "localize", "joint")
"""Modes of fits whose common errors are told."""

_PHASES = 3  # places inside a pixel, per axis, over which particles are spread
_MANY = 10**6  # events that tell whatever particles of this kind can tell at all


@dataclass(frozen=True, eq=False)
class OpticsForecast:
    """What a number of particles would tell of the microscope."""

    config: Config
    events: int
    snr: float
    values: dict[str, float]
    covariance: FloatArray
    usual: FloatArray
    moves: dict[str, FloatArray]
    sigma: dict[str, FloatArray]
    needed: pd.DataFrame

    __repr__ = brief

    @cached_property
    def parameters(self) -> pd.DataFrame:
        """One row per free parameter, with its error after the pictures and before them."""
        sigma = np.sqrt(np.diag(self.covariance))
        rows = pd.DataFrame(self.values.items(), columns=["parameter", "value"])
        told = are_told(sigma, self.usual)
        return rows.assign(sigma=sigma, usual_error=self.usual, determined=told)

    @cached_property
    def common(self) -> dict[str, dict[str, float]]:
        """Standard deviation that the microscope's errors put into all fits alike, by mode."""
        sigma = {mode: shared_sigma(moves, self.covariance) for mode, moves in self.moves.items()}
        # symmetry makes those below 1e-9 nm or kDa 0
        return _by_name({mode: np.where(each > 1e-9, each, 0.0) for mode, each in sigma.items()})

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """What the pictures would not tell, one sentence each."""
        untold = self.parameters[~self.parameters["determined"]]
        return tuple(
            f"{row.parameter} would be known to ±{row.sigma:.3g}, and to ±{row.usual_error:g} "
            "without any picture ([uncertainty] optics)"
            for row in untold.itertuples()
        )

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What the user should know."""
        faint = FAINT_PICTURES({"snr": self.snr, "least": FAINTEST})
        many = PICTURES_LEFT_OUT({"events": self.events, "used": MOST_IMAGES})
        said = ((self.snr < FAINTEST, faint), (self.events > MOST_IMAGES, many))
        return tuple(finding for applies, finding in said if applies)

    def to_dict(self) -> dict[str, Any]:
        """Give what ``iscat bounds --for optics --json`` prints."""
        mass = float(self.needed["mass_kda"][FACTORS.index(1.0)])
        return {
            "events": self.events,
            "at": {
                "mass_kda": mass,
                "height_nm": self.config.particle.nominal_height_nm,
                **picked(self.config.optics, "focus_nm", "na"),
                **picked(self.config.bounds, "photons_per_pixel", "n_before", "n_after"),
                **picked(self.config.fit, "roi_nm"),
                **picked(self.config.camera, "pixel_size_nm"),
            },
            "snr": self.snr,
            "parameters": self.parameters.to_dict("records"),
            "names": list(self.values),
            "covariance": self.covariance,
            "unidentifiable": list(self.unidentifiable),
            "common": self.common,
            "single": _by_name(self.sigma),
            "goals": dict(GOALS),
            "warnings": [finding.text for finding in self.findings],
            "needed": self.needed.to_dict("records"),
        }


def _by_name(values: Mapping[str, FloatArray]) -> dict[str, dict[str, float]]:
    """Name the free parameters of each mode."""
    return {
        mode: dict(zip(FREE_PARAMETERS[mode], each.tolist(), strict=True))
        for mode, each in values.items()
    }


@one_thread_algebra()
def forecast_optics(
    config: Config, *, events: int = EVENTS, free: str | Sequence[str] | None = None
) -> OpticsForecast:
    """Foresee what particles would tell of the microscope."""
    refuse_rod(config, "optics are learned from round particles")
    names = _names(config, free)
    number_in("`events`", events, least=1, whole=True)
    pixel, _ = detector(config)
    grid = PixelGrid.centred(config.fit.roi_px(pixel), pixel)
    reach, height = grid.diagonal_nm / 2 + pixel, config.particle.nominal_height_nm
    model = forward_model(config, reach, z_max_nm=height)
    pictures = {f: _Picture.expected(config, model, grid, f, names) for f in FACTORS}
    here = pictures[1.0]
    usual = prior_of(config).errors(names)
    settings = settings_of(config)
    return OpticsForecast(
        config=config,
        events=events,
        snr=here.snr,
        values={name: float(settings[name]) for name in names},
        covariance=_known(here.information * events, usual),
        usual=usual,
        moves={mode: here.moves(mode) for mode in MODES},
        sigma={mode: here.sigma(mode) for mode in MODES},
        needed=pd.DataFrame([_needed(picture, names, usual) for picture in pictures.values()]),
    )


def _names(config: Config, free: str | Sequence[str] | None) -> tuple[str, ...]:
    """Give the continuous parameters that these groups stand for in this microscope."""
    optics = config.optics
    if not optics.interferes or optics.convention == "dong2021":
        raise ConfigError(
            f'optics.scheme = "{optics.scheme}", optics.convention = "{optics.convention}": optics '
            'are learned from interference with a reference, in the convention "exact"'
        )
    settings = settings_of(config)
    names = tuple(
        name for group in free_groups(free) for name in FREE[group] if exists(name, settings)
    )
    if not names:
        raise ConfigError(f"free = {free!r}: this microscope has no such continuous parameter")
    return names


@dataclass(frozen=True)
class _Picture:
    """One expected particle, averaged over its place in a pixel."""

    places: tuple[tuple[Likelihood, FloatArray], ...]
    """The likelihood and θ of each."""

    names: tuple[str, ...]
    mass_kda: float
    level: bool
    information: FloatArray

    @classmethod
    def expected(
        cls,
        config: Config,
        model: ForwardModel,
        grid: PixelGrid,
        factor: float,
        names: tuple[str, ...],
    ) -> _Picture:
        at, mass, count = config.bounds, factor * model.material.mass_kda, len(names)
        light, frames, read = (
            (at.photons_per_pixel,) * 2,
            (at.n_before, at.n_after),
            detector(config)[1],
        )
        steps = grid.pixel_nm * ((np.arange(_PHASES) + 0.5) / _PHASES - 0.5)
        rest = config.particle.nominal_height_nm, model.scale.amplitude(mass), 0.0
        # of x, y, z, mass, level the height is given
        fitted = np.ix_(*[np.delete(np.arange(count + 5), count + 2)] * 2)
        places, parts = [], []
        for y, x in product(steps, steps):
            theta = np.array([x, y, *rest])
            one = expected_likelihood(model, grid, theta, light, frames, read_noise_e=read)
            places.append((one, theta))
            parts.append(eliminated(joint_information(one, theta, names)[fitted], count))
        information = np.asarray(np.mean(parts, axis=0))
        return cls(tuple(places), names, mass, config.background.slides, information)

    @property
    def snr(self) -> float:
        """Of the brightest place in a pixel's middle."""
        likelihood, theta = self.places[len(self.places) // 2]
        signal = likelihood.signal(theta)
        return math.sqrt(float(np.sum(signal**2 * likelihood.signal_information(signal))))

    def moves(self, mode: str) -> FloatArray:
        """D of a mode, averaged over the places."""
        found = [
            displacement(*place, self.names, FREE_PARAMETERS[mode], level=self.level)
            for place in self.places
        ]
        return np.asarray(np.mean(found, axis=0))

    def sigma(self, mode: str) -> FloatArray:
        """Bounds of a mode, averaged over the places."""
        free = FREE_PARAMETERS[mode]
        found = [
            event_bounds(*place, free, 1.0, level=self.level).crb_joint for place in self.places
        ]
        joint = np.sqrt(np.mean(np.square(found), axis=0))
        return np.asarray(joint[np.isfinite(joint)])


def _known(information: FloatArray, usual: FloatArray) -> FloatArray:
    """Give the covariance of the optics after pictures, from their information and the prior.

    Shapes: `information`, result (n, n); `usual` (n,).
    """
    both = np.outer(usual, usual)
    return np.asarray(np.linalg.inv(information * both + np.eye(usual.size)) * both)


def _needed(picture: _Picture, names: Sequence[str], usual: FloatArray) -> dict[str, float]:
    """Say how many events the goals take, and how many tell what can be told at all."""
    moves, mass_row = picture.moves("mass"), FREE_PARAMETERS["mass"].index("mass_kda")

    def errors(events: float) -> tuple[FloatArray, float]:
        covariance = _known(picture.information * events, usual)
        mass = shared_sigma(moves, covariance)[mass_row] / picture.mass_kda
        return np.sqrt(np.diag(covariance)), float(mass)

    def least(reached: Callable[[float], bool]) -> float:
        """Find the number of events that suffices, by halves."""
        found = 1 + bisect_left(range(1, _MANY + 1), True, key=reached)
        return float(found) if found <= _MANY else math.nan

    can = are_told(errors(_MANY)[0], usual)
    goals = dict(GOALS)
    focus = names.index("focus_nm") if "focus_nm" in names else None
    return {
        "mass_kda": picture.mass_kda,
        "snr": picture.snr,
        "identified": least(lambda n: bool(are_told(errors(n)[0], usual)[can].all())),
        "focus_nm": math.nan
        if focus is None
        else least(lambda n: bool(errors(n)[0][focus] <= goals["focus_nm"])),
        "mass_rel": least(lambda n: errors(n)[1] <= goals["mass_rel"]),
    }
