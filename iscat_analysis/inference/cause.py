"""Why a model does not describe bright particles: the shape of what it leaves over.

What the fits of several particles leave over is regressed, in standard deviations, on the change
that each parameter of the microscope makes to the picture, with the directions of the fit (place,
height, mass and level) taken out.  The parameter that explains most of χ² is named.  It is a hint:
a linear step towards another microscope, one parameter at a time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from iscat_analysis._kernels.scoring import CONDITIONAL
from iscat_analysis.config import Config
from iscat_analysis.inference.likelihood import LEVEL, Likelihood
from iscat_analysis.optics.forward import ForwardModel, forward_model
from iscat_analysis.records import BoolArray, FloatArray

WORTH_NAMING = 0.3
"""Share of χ² in excess that a parameter must explain to be named."""

_STEPS: Mapping[str, Mapping[str, float]] = {
    "focus": {"focus_nm": 20.0},
    "numerical aperture": {"na": 0.005},
    "reference phase": {"reference_phase_deg": 5.0},
    "spherical aberration": {"z11": 5.0},
    "astigmatism": {"z5": 5.0, "z6": 5.0},
    "coma": {"z7": 5.0, "z8": 5.0},
}  # small enough for a first order, and for what a table of the field resolves
_OTHERS: Mapping[str, Mapping[str, Any]] = {
    "polarisation, as if circular light passed an analyser": {
        "polarization": "circular", "analyzer": True,
    },
    "polarisation, as if linear light reached the camera without an analyser": {
        "polarization": "linear", "analyzer": False,
    },
    "mask in the pupil": {"mask_na": 0.6, "attenuation": 0.3},
    'emission = "dong2021"': {"emission": "dong2021"},
    'emission = "reciprocal"': {"emission": "reciprocal"},
}  # fmt: skip
_UNITS = {
    "focus": "nm", "reference phase": "degrees", "spherical aberration": "nm rms",
}  # fmt: skip


@dataclass(frozen=True)
class Cause:
    """What the residuals of several fits look like.

    Attributes
    ----------
    name : str
        The part of the microscope.
    share : float
        Of χ² in excess that it explains, to first order.
    step : float or None
        What would have to be added to its one parameter, to first order.
    unit : str
        Of `step`.
    events : int
        Fits that were looked at.
    """

    name: str
    share: float
    step: float | None
    unit: str
    events: int

    @property
    def message(self) -> str:
        """One line for the user."""
        by = "" if self.step is None else f", off by about {self.step:+.2g} {self.unit}".rstrip()
        return (
            f"the model does not describe the brightest particles ({self.events} looked at): what "
            f"it leaves over looks most like a wrong {self.name}{by} ({self.share:.0%} of it, to "
            "first order); correct [optics], or calibrate them"
        )


def likely_cause(
    config: Config, fits: Sequence[tuple[Likelihood, FloatArray, BoolArray]]
) -> Cause | None:
    """Name the part of the microscope whose change looks most like what fits left over.

    Parameters
    ----------
    config : Config
        The microscope as it is configured.
    fits : sequence of (Likelihood, ndarray, ndarray of bool)
        Of each particle its likelihood, θ where that is largest, and which of θ were free.

    Returns
    -------
    Cause or None
        None without fits, in dark field, or where nothing explains `WORTH_NAMING`.
    """
    if not fits or config.optics.scheme == "darkfield" or config.optics.convention != "exact":
        return None
    reach = fits[0][0].model.reach_nm
    models = {name: _neighbours(config, name, reach) for name in (*_STEPS, *_OTHERS)}
    sizes = {name: len(others) for name, others in models.items() if others}
    sums = {name: (np.zeros(k), np.zeros((k, k))) for name, k in sizes.items()}
    excess = 0.0
    for likelihood, theta, free in fits:
        residual = likelihood.residuals(theta)
        used = np.isfinite(residual)
        signal = likelihood.signal(theta)
        root = np.sqrt(likelihood.signal_information(signal))[used]
        _, first, _ = likelihood.model.amplitude_hessian(
            likelihood.grid, *(float(t) for t in theta[:4])
        )
        level = 1 + signal if likelihood.kind == CONDITIONAL else None
        columns = [first[i][used] * root for i in range(4) if free[i]]
        if free[LEVEL] and level is not None:
            columns.append(level[used] * root)
        fitted, _ = np.linalg.qr(np.stack(columns, axis=1))
        rest = residual[used]
        excess += float(rest @ rest) - rest.size
        rest = rest - fitted @ (fitted.T @ rest)
        mass = float(likelihood.model.scale.mass(theta[3]))
        place = (float(theta[0]), float(theta[1]), float(theta[2]), mass)
        for name in sums:
            change = np.stack([
                (other.image(likelihood.grid, *place) - signal)[used] * root / step
                for step, other in models[name]
            ], axis=1)  # fmt: skip
            change -= fitted @ (fitted.T @ change)
            sums[name][0][:] += change.T @ rest
            sums[name][1][:] += change.T @ change
    best: Cause | None = None
    for name, (slope, curvature) in sums.items():
        step = np.linalg.lstsq(curvature, slope, rcond=1e-9)[0]
        share = float(slope @ step) / max(excess, 1e-300)
        if excess > 0 and share > WORTH_NAMING and (best is None or share > best.share):
            size = float(step[0]) if name in _STEPS and step.size == 1 else None
            best = Cause(name, min(share, 1.0), size, _UNITS.get(name, ""), len(fits))
    return best


def _neighbours(config: Config, name: str, reach_nm: float) -> list[tuple[float, ForwardModel]]:
    """Give the microscopes that differ in one respect, and by how much; none where it is so."""
    optics = config.optics
    if name in _STEPS:
        updates: list[tuple[float, dict[str, Any]]] = [
            (step, {key: getattr(optics, key) + step})
            if hasattr(optics, key)
            else (step, {"aberrations_nm": _further(optics.aberrations_nm, key, step)})
            for key, step in _STEPS[name].items()
        ]
    else:
        other = dict(_OTHERS[name])
        same = all(getattr(optics, key) == value for key, value in other.items())
        updates = [] if same or ("mask_na" in other and optics.mask_na > 0) else [(1.0, other)]
    return [
        (
            step,
            forward_model(
                config.model_copy(update={"optics": optics.model_copy(update=update)}), reach_nm
            ),
        )
        for step, update in updates
    ]


def _further(aberrations: Mapping[str, float], key: str, step: float) -> dict[str, float]:
    return {**aberrations, key: aberrations.get(key, 0.0) + step}
