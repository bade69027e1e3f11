"""From a configuration to its forward model: optics, particle and camera → `ForwardModel`.

This module computes the amplitude of the scattered field over that of the reference, and tabulates
the field as the symmetry of the pupil allows (D21, section II; physics.md, sections 1–3 and 8).
"""

from __future__ import annotations

import cmath
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.lattice import LATTICE_STEP, reach_of_samples
from iscat_analysis._kernels.pupil import rectangle
from iscat_analysis._kernels.radial import STEP
from iscat_analysis.config import Calibration, Config, Optics, Particle
from iscat_analysis.errors import ConfigError, ContrastError
from iscat_analysis.last_used import memoize
from iscat_analysis.optics.model import (
    ForwardModel,
    MassScale,
    carry_refusal,
    collected_area_nm2,
    wiggled,
)
from iscat_analysis.optics.pixels import PixelArea, PixelGrid
from iscat_analysis.optics.scatterers import Rod, Sphere, material, rod_of, sphere_of
from iscat_analysis.optics.sized import sized
from iscat_analysis.optics.waves import (
    Aperture,
    MeasuredField,
    Template,
    aperture,
    aperture_on,
    check_table,
    critical_angle,
    field_of,
    is_coherent,
    sha256_of,
    spectrum,
)
from iscat_analysis.units import KILODALTON_KG, NM

PEAK_SEARCH_RADIUS = 4.0
"""Largest distance, over λ/NA, at which the peak contrast of a calibration is searched: out of
focus the peak lies on a ring, and the mass scale must not depend on the size of a model."""


def forward_model(
    config: Config, reach_nm: float, *, z_max_nm: float | None = None, nodes: int | None = None
) -> ForwardModel:
    """Build the forward model of a configuration."""
    optics = config.optics
    if config.calibration is not None:
        reach_nm = max(reach_nm, PEAK_SEARCH_RADIUS * optics.wavelength_nm / optics.na)
    height = config.particle.nominal_height_nm
    matter = material(config.particle, optics.wavelength_nm)
    k = 2 * math.pi / optics.wavelength_nm
    ns, ng, ni = optics.n_sample, optics.n_glass, optics.n_immersion
    paper = optics.convention == "dong2021"
    reciprocal = optics.emission == "reciprocal"
    oil_nm = height - optics.focus_nm - height * ni / ns
    if z_max_nm is None:
        z_max_nm = max(config.fit.z_range_nm[1], height)
    sphere = sphere_of(config.particle, matter.permittivity, matter.mass_kda)
    scatterer = sphere or rod_of(config.particle, matter.permittivity, ns)
    opening = _pupil(optics, reach_nm, ns * z_max_nm, ni * abs(oil_nm), nodes, scatterer)
    reflection = (ng - ns) / (ng + ns)
    transmission = math.sqrt(1 - reflection**2) if paper else 2 * ng / (ng + ns)
    if not optics.interferes:
        reference = 0.0
    elif optics.kind.reflected:
        reference = optics.attenuation * abs(reflection)
    else:
        forward = 2 * ns / (ns + ng) if reciprocal else transmission
        reference = optics.attenuation * forward
    polarizability_nm3 = complex(3 * (KILODALTON_KG / matter.density_kg_m3) / NM**3)
    if sphere is None:  # that of a sphere is in its pattern
        polarizability_nm3 *= (matter.permittivity - ns**2) / (matter.permittivity + 2 * ns**2)
    if reciprocal:
        incident = transmission if optics.kind.reflected else 1.0
        strength = (ns * k) ** 2 * polarizability_nm3 * incident / (4 * math.pi)
        front = -1j * k * ni / 2
    else:
        eta = math.asin(min(optics.na / (ni if paper else ns), 1.0)) / math.pi
        strength = eta * k**2 / math.sqrt(6 * math.pi) * polarizability_nm3 * transmission
        if paper:
            strength *= ns**2
        front = -1j * k / 2
    factor = 2 * front * strength / (reference or 1.0)
    if reference:
        factor *= cmath.exp(-1j * math.radians(optics.reference_phase_deg))
    fixed_oil_nm = -optics.focus_nm if optics.axial == "refocus" else oil_nm
    wave = field_of(opening, factor, fixed_oil_nm, reach_nm)
    model = ForwardModel(
        optics=optics,
        material=matter,
        aperture=opening,
        height_nm=height,
        reference=reference,
        rho=1.0 if reference else 0.0,
        factor=factor,
        oil_nm=fixed_oil_nm,
        wave=wave,
        strength=strength,
        reach_nm=wave.reach_nm,
        z_range_nm=(min(config.fit.z_range_nm[0], height, _lowest_nm(config)), z_max_nm),
        area=PixelArea.of(config.camera, optics),
    )
    if sphere is not None:
        model = sized(model, sphere, config.fit.diameter_range_nm)
    if optics.psf == "measured":
        template = Template.read(Path(optics.template or ""))
        template.refuse_mismatch(config.camera.pixel_size_nm, config.fit.roi_nm)
        model = with_template(model, template)
    if config.calibration is not None:  # of a particle that rests
        model = replace(model, scale=_mass_scale(model, config.calibration, config.particle))
    return wiggled(model, config.particle.wiggle_nm)


def with_template(model: ForwardModel, template: Template) -> ForwardModel:
    """Replace the computed image by a measured one."""
    wave = MeasuredField(template, peak_per_amplitude(model), model.reach_nm)
    area = replace(model.area, side=template.side)
    if not template.side:  # its picture is that of the pixels
        area = replace(area, samples=1)
    return replace(model, wave=wave, area=area, scale=MassScale())


def peak_per_amplitude(model: ForwardModel) -> float:
    """Give the magnitude of the peak contrast of a faint particle, per unit amplitude."""
    return abs(signed_peak(model))


def signed_peak(model: ForwardModel) -> float:
    """Give the peak contrast of a faint particle, per unit amplitude."""
    return _peak_terms(model)[0]


def _pupil(
    optics: Optics,
    reach_nm: float,
    sample_nm: float,
    oil_nm: float,
    nodes: int | None,
    scatterer: Sphere | Rod | None,
) -> Aperture:
    """Pupil with enough nodes for its phase; optical paths in sample and oil [nm]."""
    alpha = math.asin(optics.na / optics.n_immersion)
    k = 2 * math.pi / optics.wavelength_nm
    critical = critical_angle(optics)
    aberrations = sum(abs(size) for size in optics.aberrations_nm.values())
    if aberrations or not is_coherent(optics):
        reach_nm = reach_of_samples(reach_nm, LATTICE_STEP / (k * optics.na))
    k = max(k, 2 * math.pi / min(each.wavelength_nm for each in spectrum(optics)))
    path = optics.na * reach_nm + sample_nm + oil_nm * (1 - math.cos(alpha)) + 4 * aberrations
    intervals = math.ceil(reach_nm * k * optics.na / STEP) + 2
    check_table("the radial table", 6 * (30 + 0.45 * k * path) * intervals)
    if optics.convention == "dong2021":
        # Nodes of the rectangle rule in D21's program for fields
        return aperture_on(optics, *rectangle(alpha, nodes or 110), scatterer)
    beyond = max(0.0, (alpha - critical) / alpha) if critical else 0.0
    return aperture(
        optics,
        nodes or 16 + _in_eights(0.45 * k * path),
        nodes or 14 + _in_eights(0.45 * k * path * beyond),
        scatterer,
    )


def _in_eights(number: float) -> int:
    """Round up, so that models which differ a little in focus have the same nodes."""
    return 8 * math.ceil(number / 8)


def _lowest_nm(config: Config) -> float:
    """Give the lowest height of a fit with a normal prior, which may be below the coverslip."""
    particle = config.particle
    sd_nm = particle.height_prior_sd_nm
    if config.fit.mode != "mass" or not sd_nm:
        return math.inf
    return min(particle.mean_height_nm(0.0), particle.nominal_height_nm) - 5 * sd_nm


def _mass_scale(model: ForwardModel, line: Calibration, particle: Particle) -> MassScale:
    """Make the map from mass to amplitude, from the line and the optics of its standards."""
    if not model.rho:
        raise ConfigError("[calibration] relates contrast to mass; dark field has no contrast")
    linear, quadratic = _peak_terms(model)
    measured = isinstance(model.wave, MeasuredField)
    cause = "optics.template" if measured else f"optics.focus_nm = {model.optics.focus_nm:g}"
    _refuse_sign(linear, line, cause, "" if measured else " or the focus")
    if line.optics is None:
        return MassScale(line, linear, quadratic)
    if measured or line.optics.psf == "measured":  # whose contrasts are measured, not computed
        same = _same_template(model.optics, line.optics)
        refusal = "" if same else "they were measured with another image of a particle"
        return MassScale(line, linear, quadratic, linear, refusal)
    height = particle.nominal_height_nm if line.height_nm is None else line.height_nm
    there = particle.held_at(height)
    of_standards = _peak_of_standards(line.optics.model_dump_json(), there.model_dump_json())
    _refuse_sign(of_standards[0], line, "calibration.optics", " or these optics")
    refusal = carry_refusal(model.optics, line.optics, linear / of_standards[0])
    return MassScale(line, *of_standards, linear, refusal)


def _refuse_sign(linear: float, line: Calibration, cause: str, otherwise: str) -> None:
    if linear * line.gradient_per_kda >= 0:
        return
    seen = "bright" if linear > 0 else "dark"
    raise ContrastError(
        f"calibration.gradient_per_kda = {line.gradient_per_kda:g} has the wrong sign: with "
        f"{cause} the model's particles are {seen}; change the sign{otherwise}"
    )


def _peak_terms(model: ForwardModel) -> tuple[float, float]:
    """Give L and Q of the peak contrast L·a + Q·a² of a faint particle of amplitude a."""
    if isinstance(model.wave, MeasuredField):
        weak = 1e-6 / model.wave.gain
    else:
        weak = 1e-6 / math.sqrt(collected_area_nm2(model, model.height_nm, 1.0))
    linear, quadratic = model.wave.peak(model.height_nm, weak, model.rho)
    return linear / weak, quadratic / weak**2


def _same_template(here: Optics, there: Optics) -> bool:
    """Tell whether two measured images are the same."""
    if here.psf != "measured" or there.psf != "measured":
        return False
    if here.template == there.template:
        return True
    try:
        return (
            len({sha256_of(Path(each.template or "").read_bytes()) for each in (here, there)}) == 1
        )
    except OSError:
        return False


def _standards_peak_terms(optics: str, particle: str) -> tuple[float, float]:
    """Do what `_peak_terms` does, for the optics and the particles of standards, as JSON."""
    config = Config(
        optics=Optics.model_validate_json(optics), particle=Particle.model_validate_json(particle)
    )
    return _peak_terms(
        forward_model(config, PEAK_SEARCH_RADIUS * config.optics.wavelength_nm / config.optics.na)
    )


# optics of standards, with their contrast per kDa
_peak_of_standards = memoize(16, _standards_peak_terms)
