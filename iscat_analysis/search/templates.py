"""Where something landed: a matched filter with the model's own image.

The statistic at a pixel is the signal-to-noise ratio Σ w T c/√(Σ w T²) of the template T in the
measured signal c, w the information per pixel: twice the gain in log-likelihood is its square.  The
threshold is the height that pure noise exceeds as often as the configured number of false alarms,
by the expected Euler characteristic of a Gaussian field (Adler and Taylor, Random Fields and
Geometry, 2007), in the plane, or in the plane and along z where the height is free.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

from iscat_analysis.camera import NoiseSpectrum
from iscat_analysis.config import Detection
from iscat_analysis.errors import FloodError
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.inference.random_field import LOWEST, Excursions, extent
from iscat_analysis.optics.forward import ForwardModel, MassScale, PixelGrid, check_table
from iscat_analysis.records import Candidate, FloatArray
from iscat_analysis.search.peaks import (
    EXCEEDS,
    SAMPLED,
    is_hidden,
    maxima,
    size_on_ring,
    summits,
    vertices,
)

HEIGHTS_PER_FRINGE = 8
"""Templates per interference fringe where z is free: half-way between two the match loses 4 %."""

SIDELOBE = 0.5
"""A weaker peak inside the fitted region of a stronger one waits until that one is subtracted,
unless it reaches this share of it."""

FAR_LOBE = 0.05
"""The same beyond the region, where the rings go on: 3 % of the peak at 3 µm."""


NEAR = 1 / 3
"""Of a region: a peak nearer than this to a higher one waits in any case.  Where the model is
wrong, the first ring of a bright particle can be as high as the particle."""

LARGEST_IMAGE = 3.5
"""Regions from the centre to the edge of a strong particle's image; the rings go on, faintly."""

MOST_CANDIDATES = 1000
"""Candidates beyond which a search is given up where they are noise."""


@dataclass(frozen=True)
class ExcessNoise:
    """Noise beyond that of the camera's numbers."""

    ratio: float
    message: str


@dataclass(frozen=True)
class Templates:
    """Normalised images of the model at the searched heights."""

    z_nm: FloatArray
    images: FloatArray
    signs: FloatArray
    quadratic: bool
    threshold: float
    two_sided: bool
    excursions: Excursions
    noise: NoiseSpectrum | None = None

    def reached_by(self, ratio: float) -> float:
        """Count the places of an image that noise lifts above the threshold."""
        level = max(self.threshold / math.sqrt(ratio), LOWEST)
        return self.excursions.above(level) * (2 if self.two_sided else 1)


def make_templates(
    model: ForwardModel,
    detection: Detection,
    *,
    pixel_nm: float,
    roi_nm: float,
    z_range_nm: tuple[float, float] | None,
    field_px: tuple[int, int],
    noise: NoiseSpectrum | None = None,
    correlation: float = 0.0,
    in_turn: bool = False,
) -> Templates:
    """Prepare the matched filter for a field."""
    half = max(2, int(roi_nm / 2 / pixel_nm))
    grid = PixelGrid.centred(2 * half + 1, pixel_nm)
    if z_range_nm is None:
        heights = np.array([model.height_nm])
    else:
        low, high = z_range_nm
        count = math.ceil((high - low) / model.fringe_nm * HEIGHTS_PER_FRINGE) + 1
        check_table("the family of templates", float(count) * (2 * half + 1) ** 2)
        heights = np.linspace(low, high, count)
    bare = replace(model, scale=MassScale())
    bare = bare.at(bare.nominal_amplitude)
    weak = _weak_amplitude(bare)
    images, roughness = [], []
    for z in heights:
        signal, gradient = bare.gradient(grid, 0.0, 0.0, float(z), weak)
        images.append(signal / (weak**2 if bare.rho == 0 else weak))
        roughness.append(_roughness(signal, gradient[: 2 if z_range_nm is None else 3], noise))
    stacked = np.stack(images)
    flat = stacked.reshape(heights.size, -1)
    extremes = flat[np.arange(heights.size), np.abs(flat).argmax(axis=1)]
    two_sided = z_range_nm is None and model.rho > 0 and detection.polarity == "both"
    rough = np.mean(roughness, axis=0)
    size = field_px[0] * field_px[1] * pixel_nm**2
    area, volume = extent(rough[:2, :2], size), 0.0
    if z_range_nm is not None:
        volume = extent(rough, size * float(heights[-1] - heights[0]))
    alarms = detection.false_alarms_per_movie / (2 if two_sided else 1)
    along = _autocorrelation(stacked[0], noise) if in_turn and two_sided else None
    of_pixel = extent(rough[:2, :2], pixel_nm**2)
    excursions = Excursions(area, volume, correlation, along, of_pixel)
    return Templates(
        z_nm=heights,
        images=stacked,
        signs=np.sign(extremes),
        quadratic=model.rho == 0,
        threshold=excursions.level(alarms),
        two_sided=two_sided,
        excursions=excursions,
        noise=noise,
    )


def signal_to_noise(
    likelihood: Likelihood, templates: Templates, explained: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Matched-filter maps.

    Shapes: `explained` (y, x), `snr` (n, y, x), `strength` (n, y, x).
    """
    weight = likelihood.signal_information(explained)
    signal = np.nan_to_num(likelihood.measured_signal())
    if explained is not None:
        signal = signal - explained
    weighted = np.where(weight > 0, weight * signal, 0.0)
    duals = templates.images if templates.noise is None else templates.noise.dual(templates.images)
    norm = _correlate(weight, templates.images * duals)
    if templates.noise is not None:
        weighted = templates.noise.whitened(weighted, np.maximum(weight, 0.0))
    overlap = _correlate(weighted, templates.images)
    norm = np.maximum(norm, 1e-9 * norm.max() if norm.max() > 0 else 1.0)
    return overlap / np.sqrt(norm), overlap / norm


def find_particles(
    likelihood: Likelihood,
    templates: Templates,
    detection: Detection,
    *,
    roi_px: float,
    explained: FloatArray | None = None,
    known: Sequence[tuple[float, float]] = (),
    excess_noise: ExcessNoise | None = None,
    cumulants: tuple[FloatArray, FloatArray] | None = None,
) -> tuple[Candidate, ...]:
    """Peaks of the matched filter above the threshold, strongest first.

    A peak much weaker than another may be its side lobe and is held back, a little weaker inside
    its region, far weaker anywhere; call again with the strong one explained.

    Shapes: `explained` (y, x).
    """
    snr, strength = signal_to_noise(likelihood, templates, explained)
    ranked = np.abs(snr) if templates.two_sided else snr
    wanted = detection.sign
    if wanted:
        signs = templates.signs[:, None, None] * np.sign(snr)
        ranked = np.where(signs == wanted, np.abs(snr) if not templates.quadratic else snr, 0.0)
        if not templates.two_sided and templates.z_nm.size > 1:
            ranked = np.where(snr > 0, ranked, 0.0)
    signed = snr
    if cumulants is not None:
        lift = _lift(likelihood, templates, explained, cumulants)
        ranked, signed = ranked / lift, snr / lift
    best = ranked.max(axis=0)
    peaks = sorted(_peaks(ranked, best, signed, templates.threshold), key=lambda p: -p.height)
    refuse_flood(len(peaks), templates, excess_noise)
    found: list[Candidate] = []
    for peak in peaks:
        if any(_is_lobe(peak, other, roi_px) for other in found):
            continue
        at = peak.layer, peak.row, peak.column
        higher = peak.height / float(ranked[at])
        z_nm, beside = float(templates.z_nm[peak.layer]), _strongest_lobe(best, peak, known, roi_px)
        mass = _mass(likelihood.model, templates, float(strength[at]) * higher)
        snr_there = float(snr[at]) * higher
        found.append(Candidate(peak.x_px, peak.y_px, z_nm, mass, snr_there, beside))
    return tuple(found)


class _Peak(NamedTuple):
    """A maximum of the ranked maps: its layer and pixel, and where and how high it is between."""

    layer: int
    row: int
    column: int
    y_px: float
    x_px: float
    height: float


def _is_lobe(peak: _Peak, other: Candidate, roi_px: float) -> bool:
    """Whether a peak may be a side lobe of a higher one, or is too near to it to tell."""
    x, y = abs(peak.column - other.x_px), abs(peak.row - other.y_px)
    share = SIDELOBE if max(x, y) < roi_px else FAR_LOBE
    return peak.height < abs(other.snr) * share or math.hypot(x, y) < NEAR * roi_px


def _peaks(
    ranked: FloatArray, best: FloatArray, signed: FloatArray, threshold: float
) -> list[_Peak]:
    """Find maxima above the threshold, whose height is interpolated between pixels and heights.

    The interpolation is in the signed field, which is smooth; its magnitude has kinks at zero.
    """
    row, column = maxima(best[None], SAMPLED * threshold, (0, 1, 1))[:, 1:].T
    heights = ranked[:, row, column].T
    layer = heights.argmax(axis=1)
    dy, dx, above = summits(signed, np.stack([layer, row, column], axis=1))
    height = best[row, column] + above + vertices(heights, layer)[1]
    columns = [part.tolist() for part in (layer, row, column, row + dy, column + dx, height)]
    return [_Peak(*each) for each in zip(*columns, strict=True) if each[-1] > threshold]


def _strongest_lobe(
    best: FloatArray, peak: _Peak, known: Sequence[tuple[float, float]], roi_px: float
) -> float:
    """Height of the residuals of known particles at a candidate's distance from each.

    The nearest particles are tried first; the search ends with one that hides the candidate.
    """
    place = peak.x_px, peak.y_px
    away = {k: math.dist(k, place) for k in known}
    near = sorted((k for k in away if away[k] < LARGEST_IMAGE * roi_px), key=lambda k: away[k])
    lobe = 0.0
    for k in near:
        lobe = max(lobe, size_on_ring(best, k, place, [o for o in near if o is not k]))
        if is_hidden(peak.height, EXCEEDS * lobe):
            break
    return lobe


def refuse_flood(
    candidates: int,
    templates: Templates,
    excess_noise: ExcessNoise | None,
    *,
    images: int = 1,
    frames: str = "",
) -> None:
    """Stop a search in which noise passes the threshold, but not one with many particles.

    The rings of many particles look like noise as well; but normal noise of that variance would
    hardly pass the threshold.
    """
    if excess_noise is None or candidates <= MOST_CANDIDATES:
        return
    # of these that noise must account for; particles have a thousand times as many
    if images * templates.reached_by(excess_noise.ratio) > 0.1 * candidates:
        raise FloodError(
            f"{candidates} places{frames} pass the detection threshold: {excess_noise.message}"
        )


def _lift(
    likelihood: Likelihood,
    templates: Templates,
    explained: FloatArray | None,
    cumulants: tuple[FloatArray, FloatArray],
) -> FloatArray:
    """How much higher than normal noise the noise of few counts reaches equally often.

    Notes
    -----
    The quantile of E. A. Cornish and R. A. Fisher, Rev. Inst. Int. Stat. 5, 307 (1938), to the
    fourth cumulant.
    """
    weight = likelihood.signal_information(explained)
    scale = likelihood.data[2]
    per_count = np.where(weight > 0, weight / np.where(weight > 0, scale, 1.0), 0.0)
    variance = _correlate(weight, templates.images**2)
    variance = np.maximum(variance, 1e-9 * variance.max() if variance.max() > 0 else 1.0)
    skew = _correlate(per_count**3 * cumulants[0], templates.images**3) / variance**1.5
    tails = _correlate(per_count**4 * cumulants[1], templates.images**4) / variance**2
    u = templates.threshold
    quantile = (
        u + skew * (u**2 - 1) / 6 + tails * (u**3 - 3 * u) / 24 - skew**2 * (2 * u**3 - 5 * u) / 36
    )
    return np.maximum(quantile / u, 1.0)


def _autocorrelation(template: FloatArray, noise: NoiseSpectrum | None) -> FloatArray:
    """Correlation of the filtered noise with itself at every distance, shape (2k, 2k)."""
    dual = template if noise is None else noise.dual(template)
    size = [2 * side for side in template.shape]
    overlap = irfft2(rfft2(template, size) * np.conj(rfft2(dual, size)), size)
    out: FloatArray = overlap / overlap[0, 0]
    return np.clip(out, -0.99, 1.0)


def _correlate(image: FloatArray, kernels: FloatArray) -> FloatArray:
    """Cross-correlation of an image with centred kernels (n, k, k), shape (n, y, x)."""
    rows, columns = image.shape
    half = kernels.shape[1] // 2
    padded = [next_fast_len(size + 2 * half, real=True) for size in image.shape]
    spectrum = rfft2(image, padded)
    out = np.empty((len(kernels), rows, columns))
    for k, kernel in enumerate(kernels):
        full = irfft2(spectrum * rfft2(kernel[::-1, ::-1], padded), padded)
        out[k] = full[half : half + rows, half : half + columns]
    return out


def _weak_amplitude(bare: ForwardModel) -> float:
    """Amplitude whose signal is linear; in dark field any will do."""
    nominal = bare.material.mass_kda
    peak = abs(bare.peak_contrast(bare.height_nm, nominal))
    return nominal * min(1.0, 1e-4 / max(peak, 1e-30)) if bare.rho else nominal


def _mass(model: ForwardModel, templates: Templates, strength: float) -> float:
    """Mass from the linear estimate: of the amplitude, or of its square in dark field."""
    amplitude = math.sqrt(max(strength, 0.0)) if templates.quadratic else strength
    return float(model.scale.mass(np.asarray(amplitude)))


def _roughness(
    signal: FloatArray, gradient: NDArray[np.float64], noise: NoiseSpectrum | None
) -> FloatArray:
    """Covariance of the gradient of the unit-variance field that the filter makes of noise."""
    dual = signal if noise is None else noise.dual(signal)
    duals = gradient if noise is None else noise.dual(gradient)
    norm = np.sum(signal * dual)
    cross = np.einsum("iyx,jyx->ij", gradient, duals) / norm
    along = np.einsum("iyx,yx->i", gradient, dual) / norm
    covariance: FloatArray = cross - np.outer(along, along)
    return covariance
