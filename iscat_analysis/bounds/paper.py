"""Dong et al. (2021), whole: every panel and Table 1, in the authors' convention and exactly.

The authors' convention is that of their program (physics.md, section 7): 110 nodes of a rectangle
rule, a z derivative that refocuses, points on ``linspace(-2, 2 µm, 151)``, and one normalisation,
the scattered photons on that field at z = focus = 0.  The exact curves use the default model, hold
the stage when the particle moves, and are per collected photon, as the quantum bounds are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal

import numpy as np
import pandas as pd

from iscat_analysis._kernels.pupil import make_pupil, rectangle
from iscat_analysis.bounds.experiment import plan
from iscat_analysis.bounds.quantum import Measure, quantum_bounds, quantum_information
from iscat_analysis.config import Config, parse_config
from iscat_analysis.optics.forward import ForwardModel, forward_model
from iscat_analysis.records import PARAMETERS, FloatArray, Progress, silent
from iscat_analysis.threads import threads

Convention = Literal["dong2021", "exact"]

SCHEMES = ("iscat", "cobri", "darkfield")

OPTICS: dict[str, Any] = {
    "wavelength_nm": 517.5, "na": 1.3, "n_immersion": 1.5, "n_glass": 1.5, "n_sample": 1.33,
    "emission": "dong2021",
}  # fmt: skip
PARTICLE: dict[str, Any] = {
    "kind": "gold",
    "permittivity": (-3.7328, 2.7725),
    "density_kg_m3": 19300.0,
    "diameter_nm": 30.0,
}
"""D21, appendix C."""

COBRI_ATTENUATION = 0.0601
"""Makes COBRI's reference as strong as iSCAT's (D21, Fig. 2)."""

PIXELS = 151
FIELD_NM = 4000.0
FOCUS_NM = 1000.0
HEIGHT_NM = 5.0
"""Field, focus of Figs. 2 and 4a–b, and height of Figs. 3 and 4c–d [nm]."""

IMAGE_HEIGHTS_NM = (0.0, 500.0, 950.0, 1000.0, 1500.0)
"""Heights of Fig. 2a; D21 does not print its own.  950 → 1000 nm is a quarter of iSCAT's fringe."""

HEIGHTS_NM = np.arange(0.0, 3001.0, 10.0)
FOCI_NM = np.arange(-5000.0, 5001.0, 50.0)
ATTENUATIONS: dict[str, tuple[float, ...]] = {
    "iscat": (1.0, 0.1, 0.03, 0.01),
    "cobri": (COBRI_ATTENUATION, 0.006, 0.002, 0.0006),
    "darkfield": (0.0,),
}
"""Abscissae of the curves, and the references of Fig. 4; Figs. 2 and 3 have the first."""

FIGURE_4 = {
    "iscat": (("4b",), ("4d",)),
    "cobri": (("4a",), ("4c",)),
    "darkfield": (("4a", "4b"), ("4c", "4d")),
}
"""Panels of Fig. 4 that show a scheme, over z and over focus; dark field is where both end."""

PANELS = {
    "2b": ("phase",), "2c": ("snr",), "2d": ("x", "y"), "2e": ("z",), "3": ("mass", "mass joint"),
    "4a": ("z",), "4b": ("z",), "4c": ("mass",), "4d": ("mass",),
}  # fmt: skip
"""What each panel shows, as `point` names it."""

TABLE_NODES = 100
"""Nodes per angle of the authors' rectangle rule for Table 1."""

PRINTED = {"x": 71.0, "y": 57.0, "z_iscat": 18.0, "z_cobri": 114.0, "mass": 0.5}
"""Table 1 as printed [nm; relative], and the mass bound of the text."""


@dataclass(frozen=True)
class Reproduction:
    """Everything D21 shows."""

    curves: pd.DataFrame
    images: dict[tuple[str, float], FloatArray]
    table: pd.DataFrame
    quantum: dict[tuple[str, str], FloatArray]


def paper_config(
    scheme: str,
    convention: Convention = "exact",
    *,
    z_nm: float = HEIGHT_NM,
    focus_nm: float = 0.0,
    attenuation: float | None = None,
    optics: Mapping[str, Any] | None = None,
) -> Config:
    """Set up D21's microscope."""
    authors = convention == "dong2021"
    if attenuation is None:
        attenuation = ATTENUATIONS[scheme][0]
    return parse_config(
        {
            "optics": {
                **OPTICS,
                "scheme": scheme,
                "focus_nm": focus_nm,
                "attenuation": attenuation,
                "convention": convention,
                "axial": "refocus" if authors else "stage",
                **(optics or {}),
            },
            "camera": {  # the paper samples the light at the centres of pixels
                "pixel_size_nm": FIELD_NM / (PIXELS - 1 if authors else PIXELS),
                "samples_per_pixel": 1,
            },
            "particle": {**PARTICLE, "height_nm": z_nm},
            "bounds": {"pixels": PIXELS, "n_before": 0, "n_after": 1, "photons_per_pixel": 1.0},
            "fit": {"mode": "joint"},
        }
    )


def photons_of_authors(scheme: str, attenuation: float | None = None) -> float:
    """Scattered photons on the field at z = focus = 0, the authors' normalisation."""
    return plan(
        paper_config(scheme, "dong2021", z_nm=0.0, focus_nm=0.0, attenuation=attenuation)
    ).on_camera


def point(config: Config, photons: float | None) -> dict[str, float]:
    """Bounds of one set-up by quantity, normalised as the figures are; phase and signal on axis."""
    experiment = plan(config)
    model, z_nm, at = experiment.model, float(experiment.theta[2]), np.zeros(1)
    found = experiment.bounds(PARAMETERS)
    root = math.sqrt(experiment.collected if photons is None else photons)
    per_photon = np.array([1, 1, 1, 1 / experiment.mass_kda]) * root
    along = complex(model.field(at, at, z_nm, experiment.mass_kda)[0, 0])
    signal = abs(along) ** 2 + 2 * model.rho * along.real
    scale = float(experiment.likelihood.data[2, 0, 0])
    return {
        **dict(zip(("x", "y", "z", "mass"), found.crb_single * per_photon, strict=True)),
        "mass joint": (found.crb_joint * per_photon)[3],
        "phase": math.atan2(along.imag, along.real) if model.rho else math.nan,
        "snr": signal / math.sqrt(model.rho + signal) * math.sqrt(scale) / root,
    }


def reproduce(*, progress: Progress = silent) -> Reproduction:
    """Compute every panel and Table 1."""
    jobs: list[tuple[tuple[str, ...], str, Convention, float]] = []
    conventions: tuple[Convention, ...] = ("dong2021", "exact")
    for convention, scheme in product(conventions, SCHEMES):
        over_z, over_focus = FIGURE_4[scheme]
        first, *others = ATTENUATIONS[scheme]
        jobs.append((("2b", "2c", "2d", "2e", *over_z), scheme, convention, first))
        jobs.append((("3", *over_focus), scheme, convention, first))
        jobs += [
            (panels, scheme, convention, attenuation)
            for attenuation in others
            for panels in (over_z, over_focus)
        ]
    parts: list[pd.DataFrame] = []
    with threads(2) as pool:
        for done, part in enumerate(pool.map(lambda job: _curves(*job), jobs), start=1):
            parts.append(part)
            progress("curves of Dong et al. (2021)", done, len(jobs))
    images = {(scheme, z): _intensity(scheme, z) for scheme in SCHEMES for z in IMAGE_HEIGHTS_NM}
    measures: tuple[Measure, ...] = ("dong2021", "exact")
    quantum: dict[tuple[str, str], FloatArray] = {
        (measure, scheme): _single(_model(scheme), measure)
        for measure, scheme in product(measures, SCHEMES)
    }
    return Reproduction(pd.concat(parts, ignore_index=True), images, table1(), quantum)


def _curves(
    panels: tuple[str, ...], scheme: str, convention: Convention, attenuation: float
) -> pd.DataFrame:
    over_z = panels[0] in ("2b", "4a", "4b")
    photons = photons_of_authors(scheme, attenuation) if convention == "dong2021" else None
    axis = HEIGHTS_NM if over_z else FOCI_NM
    places = ((value, FOCUS_NM) if over_z else (HEIGHT_NM, value) for value in axis)
    points = pd.DataFrame(
        point(
            paper_config(scheme, convention, z_nm=z, focus_nm=focus, attenuation=attenuation),
            photons,
        )
        for z, focus in places
    )
    points["phase"] = np.unwrap(points["phase"])
    common = {"scheme": scheme, "convention": convention, "attenuation": attenuation}
    frames = [
        pd.DataFrame({"panel": panel, **common, "quantity": name, "x": axis, "value": points[name]})
        for panel in panels
        if not (panel == "2b" and scheme == "darkfield")
        for name in PANELS[panel]
    ]
    return pd.concat(frames, ignore_index=True)


def _intensity(scheme: str, z_nm: float) -> FloatArray:
    """Compute the detected over the incident intensity (Fig. 2a)."""
    config = paper_config(scheme, z_nm=z_nm, focus_nm=FOCUS_NM)
    experiment = plan(config)
    model = experiment.model
    signal = model.image(experiment.grid, 0.0, 0.0, z_nm, experiment.mass_kda)
    return model.reference**2 * (1 + signal) if model.rho else signal


def _model(scheme: str, emission: str = "dong2021") -> ForwardModel:
    return forward_model(paper_config(scheme, optics={"emission": emission}), 1.0)


def table1() -> pd.DataFrame:
    """Make Table 1: quantum bounds per collected photon, five ways."""
    ways: dict[str, Callable[[str], FloatArray]] = {
        "authors": rectangle_rule_bounds,
        "dong2021": lambda scheme: _single(_model(scheme), "dong2021"),
        "exact": lambda scheme: _single(_model(scheme), "exact"),
        "reciprocal": lambda scheme: _single(_model(scheme, emission="reciprocal"), "exact"),
    }
    found = {way: {s: of(s) for s in ("iscat", "cobri")} for way, of in ways.items()}
    rows = []
    for name, printed in PRINTED.items():
        quantity, _, scheme = name.partition("_")
        at = ("x", "y", "z", "mass").index(quantity)
        unit = "relative" if quantity == "mass" else "nm"
        row: dict[str, Any] = {"quantity": name, "unit": unit, "printed": printed}
        rows.append(row | {way: of[scheme or "iscat"][at] for way, of in found.items()})
    return pd.DataFrame(rows)


def _single(model: ForwardModel, measure: Measure) -> FloatArray:
    return quantum_bounds(quantum_information(model, HEIGHT_NM, measure=measure))[0]


def rectangle_rule_bounds(scheme: str) -> FloatArray:
    """Table 1 as the authors' program computes it.

    100 × 100 points of ``linspace(0, α)`` and ``linspace(0, 2π)``, all of equal weight, so that
    φ = 0 counts twice.

    Shapes: result (4,).
    """
    model = _model(scheme)
    optics = model.optics
    theta, weight = rectangle(math.asin(optics.na / optics.n_immersion), TABLE_NODES)
    pupil = make_pupil(
        theta, weight, wavenumber=model.wavenumber, n_immersion=optics.n_immersion,
        n_glass=optics.n_glass, n_sample=optics.n_sample,
        direction=optics.direction, reciprocal=False,
    )  # fmt: skip
    phi = np.linspace(0.0, 2 * math.pi, TABLE_NODES)
    p, s = np.abs(pupil.t_p_cos) ** 2, np.abs(pupil.t_s) ** 2
    density = np.outer(p, np.cos(phi) ** 2) + np.outer(s, np.sin(phi) ** 2)
    density *= pupil.apodization[:, None] ** 2
    density /= density.sum()
    kappa = pupil.axial.real / (1.0 if optics.kind.reflected else optics.n_sample)
    slopes = (
        np.outer(pupil.transverse, np.cos(phi)),
        np.outer(pupil.transverse, np.sin(phi)),
        np.outer(kappa, np.ones(phi.size)),
        np.ones(density.shape),
    )
    return np.array([1 / math.sqrt(4 * float((q**2 * density).sum())) for q in slopes])
