"""Bright steps that no dipole describes: spheres, and images as the movie shows them.

The search for dipoles would take the rings of a large particle for steps of their own; spheres are
therefore found by their light and fitted before all others.

A vesicle or an aggregate is no point, and what the model leaves over of it hides what lands in the
same frames, all over the field: each peak of it may be a particle with lobes of its own, for which
fainter ones wait.  Such a step is taken off with a picture of its own: the contrast
between the frames with and without it, averaged along rings around its centre of symmetry,

    C(r, φ) = Σ_k h_k(φ) c_k(r),    h = 1, cos φ, sin φ, cos 2φ, sin 2φ,

with c_k linear between knots.  The rings are those of a scatterer of any size in any polarisation;
a particle beside it is much narrower than a ring, counts as an outlier of it, and stays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice, takewhile

import numpy as np
from scipy import fft

from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.fitting.events import BRIGHT_SNR, IN_VAIN, Region
from iscat_analysis.inference.counts import conditional
from iscat_analysis.inference.fit import fit_particle
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.inference.recognition import may_be_large, model_of, recognised
from iscat_analysis.landing.neighbours import Neighbours, Step, distance_px
from iscat_analysis.optics.forward import PixelGrid
from iscat_analysis.records import Candidate, FitResult, FloatArray, Mapper
from iscat_analysis.search.bright import BrightStep, find_bright_steps
from iscat_analysis.search.dating import StepFrame
from iscat_analysis.search.peaks import RINGS, chi2_excess, summits
from iscat_analysis.search.sliding import STRIDES

_LEAST_MISFIT_SHARE = 0.1  # share of a misfit that alone passes the threshold where it hides others
# Farthest that the centre may lie from the fit of the model, in sides of the region.
_LARGEST_SHIFT_SHARE = 0.35


def large_steps(neighbours: Neighbours, mapper: Mapper) -> tuple[list[Step], bool]:
    """Find bright steps that a sphere describes and a dipole does not; tell if trying is in vain.

    With wrong optics dipoles describe no bright step, and spheres neither.
    """
    context = neighbours.context
    if not context.spheres_of(context.model):
        return [], False
    chunk, window = neighbours.chunk, neighbours.window
    bright = find_bright_steps(chunk, window, context.config, mapper=mapper)
    clear = takewhile(lambda step: step.snr >= BRIGHT_SNR, bright.every())
    nominal, z_range = context.model.material.mass_kda, context.config.fit.z_range_nm

    def tried(step: BrightStep) -> list[tuple[int, Likelihood, FitResult]] | None:
        """Fit spheres that land or leave; None where a dipole suffices."""
        landing = _likelihood_of(context, step, 1)
        start = Candidate(step.x_px, step.y_px, context.height_nm(nominal), nominal, step.snr)
        dipole = fit_particle(landing, start, context.mode, z_range, level=True)
        if not may_be_large(landing, dipole):
            return None
        found = []
        for sign in (1, -1):
            likelihood = landing if sign > 0 else _likelihood_of(context, step, sign)
            spheres = context.spheres_of(likelihood.model)
            sphere = recognised(likelihood, dipole, spheres, z_range, level=True)
            if sphere is not None:
                found.append((sign, *sphere))
        return found

    steps: list[Step] = []
    vain = failed = 0
    while batch := list(islice(clear, IN_VAIN - vain)):
        for step, found in zip(batch, mapper(tried, batch), strict=True):
            vain = 0 if found else vain + 1
            failed += found is not None
            if found:
                sign, seated, fit = max(found, key=lambda one: one[2].log_likelihood)
                at = StepFrame.undated(step.frame, neighbours.stride)
                steps.append(neighbours.draw_sphere(sign, at, model_of(seated), fit))
    return steps, not steps and failed >= IN_VAIN


def _likelihood_of(context: AnalysisContext, step: BrightStep, sign: int) -> Likelihood:
    """Make the likelihood of a step that lands or leaves, in the square that is fitted at most."""
    rows, columns = (_middle(part, context.roi_px) for part in (step.rows, step.columns))
    (top, bottom), (left, right) = rows, columns
    y, x = step.rows[0], step.columns[0]
    windows = step.windows.cut((slice(top - y, bottom - y), slice(left - x, right - x)))
    before, after = (windows.before_e, windows.after_e)[::sign]
    one, other = (windows.read_variance_before_e2, windows.read_variance_after_e2)[::sign]
    model = context.model_at(step.x_px * context.pixel_nm, step.y_px * context.pixel_nm, step.frame)
    grid, ratio = PixelGrid.region(rows, columns, context.pixel_nm), windows.power_ratio**sign
    counts = before, after, ratio
    return conditional(model, grid, *counts, read_variances_e2=(one, other), masked=windows.masked)


def _middle(span: tuple[int, int], most: int) -> tuple[int, int]:
    """Give the middle of a range of pixels, as many as that at most."""
    first = span[0] + max(span[1] - span[0] - most, 0) // 2
    return first, first + min(span[1] - span[0], most)


def with_measured_images(
    steps: Sequence[Step], near: Sequence[Sequence[int]], neighbours: Neighbours
) -> list[Step]:
    """Give those steps their measured pictures of which what is left over could hide others.

    Two lobes of one picture that the model does not describe may both have been taken for steps:
    the weaker one is left out.
    """
    threshold = neighbours.context.templates.threshold
    chosen: list[int] = []
    lobes: set[int] = set()
    # those that are measured come first, then those of which the model leaves over most
    order = [(not s.is_measured, -s.excess, -s.start.snr, i) for i, s in enumerate(steps)]
    for *_, i in sorted(order):
        step = steps[i]
        sphere = neighbours.are_spheres or step.sphere is not None
        if not (step.is_measured or _hides_others(step, threshold, sphere=sphere)):
            continue
        middle = next((steps[k] for k in chosen if _is_lobe(step, steps[k], neighbours)), None)
        if middle is None:
            chosen.append(i)
        elif not middle.is_measured:
            lobes.add(i)
    measured = list(steps)
    for _ in range(2):  # since pictures overlap
        for i in chosen:
            others = [measured[k] for k in near[i] if k not in lobes]
            measured[i] = _measured(measured[i], others, neighbours)
    return [step for i, step in enumerate(measured) if i not in lobes]


def _hides_others(step: Step, threshold: float, *, sphere: bool) -> bool:
    """Whether the misfit of a step could hide others.

    It does if the model misses a little of a very bright picture, or nearly all of a picture.  In
    between it may be two particles that land at once.  A sphere that was fitted as one has the
    right picture, unless what it misses says otherwise.
    """
    if sphere:
        return step.excess > (threshold / _LEAST_MISFIT_SHARE) ** 2
    described = step.excess < 0.1 * step.snr**2
    if described and RINGS * step.start.snr > threshold:
        return True
    return step.excess > max(4 * step.snr**2, (threshold / _LEAST_MISFIT_SHARE) ** 2)


def _is_lobe(step: Step, brighter: Step, neighbours: Neighbours) -> bool:
    """Whether a step is in the middle of the picture of a brighter step, at the same time."""
    near = distance_px(step, brighter) < 2 * _LARGEST_SHIFT_SHARE * neighbours.roi_px
    return near and abs(step.at.frame - brighter.at.frame) <= neighbours.window // STRIDES


def _measured(step: Step, others: Sequence[Step], neighbours: Neighbours) -> Step:
    """Replace the picture of a step by the measured one, if there are frames for that."""
    chunk, window, roi_px = neighbours.chunk, neighbours.window, neighbours.roi_px
    rows, columns = step.drawn.rows, step.drawn.columns
    frame, gap = step.at.frame, min(step.at.gap, window // 5)
    begin, end = max(frame - window, chunk.first), min(frame + window, chunk.stop)
    spans = (begin, max(frame - gap, begin)), (min(frame + gap, end), end)
    patch = chunk.patch(begin, end, rows, columns)
    windows = patch.windows(*spans)
    if not windows.n_before or not windows.n_after:
        return step
    before, after = windows.before_e, windows.after_e
    ratio = np.full(before.shape, windows.power_ratio)
    cuts = chunk.cut(*spans[0]), chunk.cut(*spans[1])
    for other in others:
        neighbours.apply(ratio, other, *cuts, Region(rows, columns))
    used = patch.usable & (before > 0) & (after > 0)
    before, after = (np.where(used, part, 1.0) for part in (before * ratio, after))
    if step.sign < 0:
        before, after = after, before
    contrast = np.where(used, after / before - 1, 0.0)
    sigma = np.sqrt((1 / before + 1 / after) * (1 + contrast) ** 2)
    weight = np.where(used, 1 / sigma, 0.0)
    place = step.start.y_px - rows[0], step.start.x_px - columns[0]
    centre = _centre(contrast * weight, place, _LARGEST_SHIFT_SHARE * roi_px)
    image = np.maximum(ring_average(contrast, weight, centre), contrast.min())  # no light is less
    half = roi_px // 2
    y, x = (max(round(c) - half, 0) for c in place)
    core = slice(y, y + 2 * half + 1), slice(x, x + 2 * half + 1)
    excess = chi2_excess(((contrast - image) * weight)[core])
    return replace(step, drawn=step.drawn.measured(image), excess=excess, is_measured=True)


def _centre(
    signal: FloatArray, place: tuple[float, float], wander_px: float
) -> tuple[float, float]:
    """Find the point about which a picture is symmetric, near a place.

    Rings of even order look the same from the other side: the picture convolved with itself is
    highest at twice their centre.

    Shapes: `signal` (ny, nx).
    """
    size = [fft.next_fast_len(2 * n, real=True) for n in signal.shape]
    twice = fft.irfft2(fft.rfft2(signal, size) ** 2, size)
    low = [max(math.ceil(2 * (c - wander_px)), 1) for c in place]
    high = [math.floor(2 * (c + wander_px)) + 1 for c in place]
    near = twice[low[0] : high[0], low[1] : high[1]]
    i, j = np.unravel_index(int(np.argmax(near)), near.shape)
    at = np.array([[0, i + low[0], j + low[1]]], dtype=np.int64)
    dy, dx, _ = summits(twice[None], at)
    return float(at[0, 1] + dy[0]) / 2, float(at[0, 2] + dx[0]) / 2


def ring_average(
    contrast: FloatArray, weight: FloatArray, centre: tuple[float, float]
) -> FloatArray:
    """Average a picture along rings, with their first two harmonics; outliers count less.

    Shapes: `contrast, weight` (ny, nx), result (ny, nx).
    """
    y, x = (np.arange(n) - c for n, c in zip(contrast.shape, centre, strict=True))
    from scipy import sparse
    from scipy.sparse.linalg import spsolve

    # between knots; rings are half a wavelength apart, some two pixels
    radius = np.hypot(y[:, None], x[None, :]).ravel() / 0.6
    angle = np.arctan2(y[:, None], x[None, :] + 0 * y[:, None]).ravel()
    turns = angle, 2 * angle
    waves = [np.ones(angle.size), *(wave(turn) for turn in turns for wave in (np.cos, np.sin))]
    knot = np.floor(radius).astype(np.int64)
    part, places = radius - knot, (np.tile(np.arange(radius.size), 2), np.append(knot, knot + 1))
    rings = sparse.csr_matrix((np.append(1 - part, part), places))
    design = sparse.hstack([rings.multiply(wave[:, None]) for wave in waves], format="csr")
    value, accuracy = contrast.ravel(), weight.ravel()
    ridge = sparse.identity(design.shape[1]) * (1e-6 * float(np.mean(accuracy**2)))
    kept = accuracy**2
    image = np.zeros(value.size)
    # of the rings, with the outliers of the one before
    for _ in range(4):
        normal = design.T @ sparse.diags(kept) @ design + ridge
        image = design @ spsolve(normal.tocsc(), design.T @ (kept * value))
        off = np.abs(value - image) * accuracy
        scale = max(1.0, float(np.median(off[accuracy > 0])) / 0.6745)
        kept = accuracy**2 * np.minimum(1.0, 3 * scale / np.maximum(off, 1e-9)) ** 2
    return np.asarray(image.reshape(contrast.shape))
