"""Steps of particles that are no dipoles, found by their light and fitted before all others.

The search for dipoles would take the rings of a large particle for steps of their own.
"""

from __future__ import annotations

from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.fitting.large import BRIGHT_SNR, IN_VAIN
from iscat_analysis.inference.fit import fit_particle
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.inference.noise import conditional
from iscat_analysis.inference.recognition import may_be_large, model_of, recognised
from iscat_analysis.landing.neighbours import Neighbours, Step
from iscat_analysis.optics.forward import PixelGrid
from iscat_analysis.records import Candidate, Mapper
from iscat_analysis.search.bright import BrightStep, find_bright_steps
from iscat_analysis.search.sliding import Chunk, StepFrame


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
    steps: list[Step] = []
    vain = 0
    for step in bright:
        if step.snr < BRIGHT_SNR or vain == IN_VAIN:
            break
        vain += 1
        landing = _likelihood_of(context, chunk, step, 1)
        nominal = context.model.material.mass_kda
        start = Candidate(step.x_px, step.y_px, context.height_nm(nominal), nominal, step.snr)
        z_range = context.config.fit.z_range_nm
        dipole = fit_particle(landing, start, context.mode, z_range, level=True)
        if not may_be_large(landing, dipole):
            continue
        found = []
        for sign in (1, -1):
            likelihood = landing if sign > 0 else _likelihood_of(context, chunk, step, sign)
            spheres = context.spheres_of(likelihood.model)
            sphere = recognised(likelihood, dipole, spheres, z_range, level=True)
            if sphere is not None:
                found.append((sign, *sphere))
        if found:
            sign, seated, fit = max(found, key=lambda one: one[2].log_likelihood)
            at = StepFrame.undated(step.frame, stride)
            steps.append(neighbours.draw_sphere(sign, at, model_of(seated), fit))
            vain = 0
    return steps


def _likelihood_of(
    context: AnalysisContext, chunk: Chunk, step: BrightStep, sign: int
) -> Likelihood:
    """Make the likelihood of a step that lands or leaves, in the square that is fitted at most."""
    rows, columns = (_middle(part, context.roi_px) for part in (step.rows, step.columns))
    inside = (
        slice(rows[0] - step.rows[0], rows[1] - step.rows[0]),
        slice(columns[0] - step.columns[0], columns[1] - step.columns[0]),
    )
    grid = PixelGrid.region(rows, columns, context.pixel_nm)
    before, after, ratio = step.before_e[inside], step.after_e[inside], step.power_ratio
    frames = [step.n_before, step.n_after]
    if sign < 0:
        before, after, ratio = after, before, 1 / ratio
        frames.reverse()
    read = chunk.camera.read_variance_e2(chunk.shape)[slice(*rows), slice(*columns)]
    place = step.x_px * context.pixel_nm, step.y_px * context.pixel_nm
    return conditional(
        context.model_at(*place, step.frame), grid, before, after, ratio,
        read_variance_before_e2=frames[0] * read, read_variance_after_e2=frames[1] * read,
        masked=~step.usable[inside],
    )  # fmt: skip


def _middle(span: tuple[int, int], most: int) -> tuple[int, int]:
    """Give the middle of a range of pixels, as many as that at most."""
    first = span[0] + max(span[1] - span[0] - most, 0) // 2
    return first, first + min(span[1] - span[0], most)
