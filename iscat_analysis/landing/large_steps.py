"""Steps of particles that are no dipoles, found by their light and fitted before all others.

The search for dipoles would take the rings of a large particle for steps of their own.
"""

from __future__ import annotations

from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.inference.fit import fit_particle
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.inference.noise import conditional
from iscat_analysis.inference.recognition import may_be_large, recognised
from iscat_analysis.landing.neighbours import Neighbours, Step
from iscat_analysis.optics.forward import PixelGrid
from iscat_analysis.optics.seated import SeatedModel
from iscat_analysis.records import Candidate, FitResult, Mapper
from iscat_analysis.search.bright import BrightStep, find_bright_steps
from iscat_analysis.search.sliding import Chunk, StepFrame

_MOST = 64  # bright steps of a chunk that are looked at
_BRIGHT_SNR = 50.0  # below which no dipole leaves enough over of a sphere to be seen


def large_steps(
    context: AnalysisContext, chunk: Chunk, window: int, neighbours: Neighbours, mapper: Mapper
) -> list[Step]:
    """Find bright steps that a sphere describes and a dipole does not."""
    if not context.spheres_of(context.model):
        return []
    optics = context.config.optics
    _, bright = find_bright_steps(
        chunk, window, pixel_nm=context.pixel_nm, resolution_nm=optics.wavelength_nm / optics.na,
        roi_px=context.roi_px, most=0, mapper=mapper,
    )  # fmt: skip
    stride = int(chunk.edges[1] - chunk.edges[0])
    steps = []
    for step in bright[:_MOST]:
        if step.snr < _BRIGHT_SNR:
            continue
        found = [
            (*sphere, sign)
            for sign in (1, -1)
            for sphere in [_sphere_of(context, chunk, step, sign)]
            if sphere is not None
        ]
        if found:
            seated, fit, sign = max(found, key=lambda one: one[1].log_likelihood)
            at = StepFrame.undated(step.frame, stride)
            steps.append(neighbours.draw_sphere(sign, at, seated, fit))
    return steps


def _sphere_of(
    context: AnalysisContext, chunk: Chunk, step: BrightStep, sign: int
) -> tuple[SeatedModel, FitResult] | None:
    """Fit a sphere that lands or leaves; None if a dipole describes the step as well."""
    grid = PixelGrid.region(step.rows, step.columns, context.pixel_nm)
    before, after, ratio = step.before_e, step.after_e, step.power_ratio
    frames = [step.n_before, step.n_after]
    if sign < 0:
        before, after, ratio = after, before, 1 / ratio
        frames.reverse()
    read = chunk.camera.read_variance_e2(chunk.shape)[slice(*step.rows), slice(*step.columns)]
    place = step.x_px * context.pixel_nm, step.y_px * context.pixel_nm
    likelihood: Likelihood = conditional(
        context.model_at(*place, step.frame), grid, before, after, ratio,
        read_variance_before_e2=frames[0] * read, read_variance_after_e2=frames[1] * read,
        masked=~step.usable,
    )  # fmt: skip
    nominal = context.model.material.mass_kda
    start = Candidate(step.x_px, step.y_px, context.height_nm(nominal), nominal, step.snr)
    z_range = context.config.fit.z_range_nm
    fit = fit_particle(likelihood, start, context.mode, z_range, level=True)
    if not may_be_large(likelihood, fit):
        return None
    models = context.spheres_of(likelihood.model)
    found = recognised(likelihood, fit, models, z_range, level=True)
    if found is None or not isinstance(found[0].model, SeatedModel):
        return None
    return found[0].model, found[1]
