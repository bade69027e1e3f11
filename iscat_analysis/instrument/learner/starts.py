"""Where the search for the microscope begins: every focus, on the average of all pictures.

The pictures are registered on each other, with the sign of each, and averaged; no model takes part
in that.  For one focus the contrast of a weak particle is linear in the cosine and the sine of the
reference phase, so that the phase and the amplitude that fit the average best follow from a 2 × 2
system at every shift of the picture.  Of a strong particle one sees the scattered light itself as
well, with the square of the amplitude: the best amplitude is then the root of a cubic equation for
every phase.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import fft, ndimage

from iscat_analysis.inference.noise_models import CONDITIONAL
from iscat_analysis.instrument.learner.particle_images import Build, ParticleImage
from iscat_analysis.optics.field_map import Spot
from iscat_analysis.optics.grid import PixelGrid
from iscat_analysis.records import FloatArray

FOCUS_RANGE_NM = 1000.0
"""How far from the configured focus the search goes."""

FOCUS_STEP_NM = 80.0
"""Step of the search over focus; a quarter of the depth of field at NA 1.2."""

_FOCI = 7  # of a scan, whose averages are searched
_ROUNDS = 3  # of registration
_PARTS = 20  # of a pixel, to which it is found
_UNIT_KDA = 1e3  # at which interference and scattered light are told apart, by their powers
_TURNS = 24  # of half a circle of phases, for strong particles
_FAINT = 1e-3  # share of what is explained below which the scattered light alone is left out
_DIRECTIONS_DEG = (45.0, 90.0, 135.0)
_SHIFT_PX = 4.0  # a picture's first centre is off by no more


@dataclass(frozen=True)
class Start:
    """A microscope that resembles the average picture."""

    values: Mapping[str, Any]
    x_nm: float
    y_nm: float
    mass_kda: float
    explained: float


def average_particle_images(
    sights: Sequence[ParticleImage],
) -> tuple[tuple[ParticleImage, ...], tuple[ParticleImage, ...]]:
    """Average the pictures of each focus, registered on each other, with the sign of each."""
    placed = list(sights)
    averages = {}
    for offset in sorted({sight.focus_steps for sight in sights}):
        members = [i for i, sight in enumerate(sights) if sight.focus_steps == offset]
        averages[offset], group = _average([sights[i] for i in members])
        for i, sight in zip(members, group, strict=True):
            placed[i] = sight
    offsets = list(averages)
    chosen = np.unique(np.linspace(0, len(offsets) - 1, min(_FOCI, len(offsets))).round())
    return tuple(averages[offsets[int(i)]] for i in chosen), tuple(placed)


def _average(sights: Sequence[ParticleImage]) -> tuple[ParticleImage, list[ParticleImage]]:
    """Average pictures of one focus; their places are those of the average's centre."""
    contrasts, variances = zip(*(contrast_of(sight) for sight in sights), strict=True)
    pixel = sights[0].grid.pixel_nm
    shifts = np.array([
        (
            (sight.y_nm - float(np.mean(sight.grid.y_nm))) / pixel,
            (sight.x_nm - float(np.mean(sight.grid.x_nm))) / pixel,
        )
        for sight in sights
    ])  # fmt: skip
    template = ndimage.shift(contrasts[0], -shifts[0], order=3, mode="nearest")
    variance = np.full(template.shape, float(np.median(variances[0])))
    for _ in range(_ROUNDS if len(sights) > 1 else 0):
        total, weight = np.zeros_like(template), np.zeros_like(template)
        for index, (contrast, noise) in enumerate(zip(contrasts, variances, strict=True)):
            shifts[index] = _register(contrast, template, shifts[index])
            moved = ndimage.shift(contrast, -shifts[index], order=3, mode="nearest")
            noise = float(np.median(noise))
            scale = float(np.vdot(moved, template) / np.vdot(template, template))
            total += scale * moved / noise
            weight += scale**2 / noise
        template, variance = total / weight, 1 / weight
    data = np.zeros((4, *template.shape))
    counts = 2 / variance
    data[0], data[2], data[3] = counts * (1 + template), 1.0, 1.0
    data[1] = counts + data[0]
    grid = PixelGrid.centred(template.shape[0], pixel)
    average = ParticleImage(
        grid, CONDITIONAL, data, 0.0, 0.0, sights[0].z_nm,
        focus_steps=sights[0].focus_steps,
    )  # fmt: skip
    placed = [
        replace(
            sight,
            x_nm=float(np.mean(sight.grid.x_nm) + dx * pixel),
            y_nm=float(np.mean(sight.grid.y_nm) + dy * pixel),
        )
        for sight, (dy, dx) in zip(sights, shifts, strict=True)
    ]
    return average, placed


def contrast_of(sight: ParticleImage) -> tuple[FloatArray, FloatArray]:
    """Measured contrast of a sight and the variance of its noise.

    Shapes: `contrast, variance` (ny, nx).
    """
    terms = sight.noise.terms(sight.data, np.zeros(sight.grid.shape), 0.0)
    information = terms.information * terms.by_signal**2
    with np.errstate(divide="ignore", invalid="ignore"):
        contrast = sight.noise.measured_signal(sight.data)
    used = (information > 0) & np.isfinite(contrast)
    level = float(np.average(contrast[used], weights=information[used]))
    variance = 1 / np.where(used, information, 1e-6)
    return np.where(used, contrast - level, 0.0), variance


def _register(contrast: FloatArray, template: FloatArray, shift: FloatArray) -> FloatArray:
    """Shift of a picture from a template of either sign; the last one, where it is far from that.

    A window about the last shift would leave neighbours out, and the rings that tell aberrations.
    """
    from skimage.registration import phase_cross_correlation  # only the learner needs it

    found, *_ = phase_cross_correlation(
        template, contrast, normalization=None, upsample_factor=_PARTS
    )
    near = np.abs(found + shift).max() <= _SHIFT_PX
    return np.asarray(-found if near else shift)


def with_masses(
    sights: Sequence[ParticleImage], build: Build, settings: Mapping[str, Any]
) -> tuple[ParticleImage, ...]:
    """Give every sight the mass that fits it best where it stands."""
    models: dict[Spot, Any] = {}
    out = []
    for sight in sights:
        if sight.spot not in models:
            models[sight.spot] = build(sight.seen_with(settings))
        parts = _parts(models[sight.spot], sight, (sight.x_nm, sight.y_nm))
        contrast, variance = contrast_of(sight)
        weight = 1 / variance
        pictures = np.array([part - np.average(part, weights=weight) for part in parts])
        gram = np.einsum("yx,iyx,jyx->ij", weight, pictures, pictures)
        overlaps = np.einsum("yx,iyx,yx->i", weight, pictures, contrast)
        mass, _ = _strengths(overlaps[0], overlaps[1], gram[0, 0], gram[0, 1], gram[1, 1])
        out.append(replace(sight, mass_kda=float(mass)))
    return tuple(out)


def _parts(
    model: Any, sight: ParticleImage, place: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """Contrast per mass, and per square of the mass: interference, and the scattered light."""
    signal, slopes = model.gradient(sight.grid, *place, sight.z_nm, _UNIT_KDA)
    slope = slopes[3]
    return (2 * signal - _UNIT_KDA * slope) / _UNIT_KDA, (_UNIT_KDA * slope - signal) / _UNIT_KDA**2


def _quadratures(model: Any, sight: ParticleImage) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Contrast per mass at reference phases 0 and 90°, and scattered light per squared mass.

    The particle is in the centre.
    """
    pixels = model.pixels(sight.grid)
    along, power = np.zeros(sight.grid.shape, complex), np.zeros(sight.grid.shape)
    for down, high in zip(pixels.offsets, pixels.weights, strict=True):
        for right, wide in zip(pixels.offsets, pixels.weights, strict=True):
            dx, dy = np.meshgrid(pixels.x + right, pixels.y + down)
            field = model.field(dx, dy, sight.z_nm, _UNIT_KDA) / _UNIT_KDA
            along += wide * high * field[0]
            power += wide * high * np.sum(np.abs(field) ** 2, axis=0)
    return 2 * along.real, 2 * along.imag, power


def _strengths(
    linear: FloatArray, square: FloatArray, ll: FloatArray, ls: FloatArray, ss: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Best amplitude a of a picture a·L + a²·Q, of either sign, and the χ² that it explains.

    `linear` and `square` are the overlaps of L and Q with the data, `ll`, `ls`, `ss` their own; all
    broadcast.
    """
    linear, square, ll, ls, ss = np.broadcast_arrays(linear, square, ll, ls, ss)
    weak = linear / ll
    unit = np.where(weak == 0, 1.0, np.abs(weak))
    # b + (2 q − ll) a − 3 ls a² − 2 ss a³ = 0, in units in which the weak solution is ±1
    terms = np.stack([linear, (2 * square - ll) * unit, -3 * ls * unit**2, -2 * ss * unit**3])
    lead = np.where(np.abs(terms[3]) > 1e-12 * np.abs(terms).max(axis=0), terms[3], np.inf)
    companion = np.zeros((*weak.shape, 3, 3))
    companion[..., 1, 0] = companion[..., 2, 1] = 1.0
    companion[..., :, 2] = -np.moveaxis(terms[:3] / lead, 0, -1)
    roots = np.linalg.eigvals(companion)
    real = np.where(np.abs(roots.imag) < 1e-6 * (1 + np.abs(roots.real)), roots.real, 0.0)
    tried = np.concatenate([real * unit[..., None], weak[..., None]], axis=-1)
    b, q, g, h, k = (v[..., None] for v in (linear, square, ll, ls, ss))
    explained = 2 * (b * tried + q * tried**2) - (g * tried**2 + 2 * h * tried**3 + k * tried**4)
    best = np.argmax(explained, axis=-1)[..., None]
    return (
        np.take_along_axis(tried, best, -1)[..., 0],
        np.take_along_axis(explained, best, -1)[..., 0],
    )


def search_starts(
    averages: Sequence[ParticleImage],
    build: Build,
    candidates: Sequence[Mapping[str, Any]],
    *,
    most: int,
) -> tuple[Start, ...]:
    """Rank microscopes by how much of the average pictures they explain."""
    pixel, shape = averages[0].grid.pixel_nm, averages[0].grid.shape
    spectra = []
    for average in averages:
        contrast, variance = contrast_of(average)
        spectra.append((fft.rfft2(contrast), float(np.median(variance))))
    reach = math.ceil(_SHIFT_PX / 2)
    here = np.arange(-reach, reach + 1)
    found = []
    for values in candidates:
        gram, overlaps = np.zeros((3, 3)), np.zeros((3, here.size, here.size))
        for average, (spectrum, noise) in zip(averages, spectra, strict=True):
            model = build({**average.seen_with(values), "reference_phase_deg": 0.0})
            pictures = [picture - picture.mean() for picture in _quadratures(model, average)]
            gram += np.einsum("iyx,jyx->ij", pictures, pictures) / noise
            for k, picture in enumerate(pictures):
                match = fft.irfft2(spectrum * np.conj(fft.rfft2(picture)), s=shape)
                overlaps[k] += match[np.ix_(here, here)] / noise
        amplitude, phase, explained = _best_phase(gram, overlaps)
        row, column = np.unravel_index(int(np.argmax(explained)), explained.shape)
        found.append(
            Start(
                {**values, "reference_phase_deg": math.degrees(phase[row, column])},
                x_nm=float(here[column]) * pixel,
                y_nm=float(here[row]) * pixel,
                mass_kda=float(amplitude[row, column]),
                explained=float(explained[row, column]),
            )
        )
    found.sort(key=lambda start: -start.explained)
    kept: list[Start] = []
    for start in found:
        near = any(
            abs(start.values["focus_nm"] - other.values["focus_nm"]) < 1.5 * FOCUS_STEP_NM
            and all(start.values.get(k) == other.values.get(k) for k in ("polarization", "mask_na"))
            for other in kept
        )
        if not near:
            kept.append(start)
        if len(kept) == most:
            break
    return tuple(kept)


def _best_phase(
    gram: FloatArray, overlaps: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Amplitude, reference phase and explained χ² at every shift, shape of the last axes.

    `gram` and `overlaps` are of the pictures at phases 0 and 90°, and of the scattered light.
    """
    linear = np.einsum("ij,jyx->iyx", np.linalg.pinv(gram[:2, :2]), overlaps[:2])
    explained = np.einsum("iyx,iyx->yx", linear, overlaps[:2])
    amplitude, phase = np.hypot(*linear), np.arctan2(linear[1], linear[0])
    if amplitude.max() ** 4 * gram[2, 2] < _FAINT * explained.max():
        return amplitude, phase, explained
    turns = np.concatenate([
        np.pi * np.arange(_TURNS)[:, None, None] / _TURNS * np.ones_like(phase), phase[None]
    ])  # fmt: skip
    way = np.stack([np.cos(turns), np.sin(turns)])
    tried, gained = _strengths(
        np.einsum("itab,iab->tab", way, overlaps[:2]),
        overlaps[2],
        np.einsum("itab,ij,jtab->tab", way, gram[:2, :2], way),
        np.einsum("itab,i->tab", way, gram[:2, 2]),
        gram[2, 2],
    )
    best = np.argmax(gained, axis=0)[None]
    tried, turns, gained = (np.take_along_axis(v, best, 0)[0] for v in (tried, turns, gained))
    return np.abs(tried), turns + np.pi * (tried < 0), gained


def turned_starts(
    averages: Sequence[ParticleImage], build: Build, starts: Sequence[Start]
) -> tuple[Start, ...]:
    """Turn the linear light of every start to the direction that explains most."""
    out = []
    for start in starts:
        if start.values["polarization"] == "linear":
            first = start.values["polarization_deg"]
            turns = [{**start.values, "polarization_deg": first + t} for t in _DIRECTIONS_DEG]
            (best,) = search_starts(averages, build, turns, most=1)
            start = max(start, best, key=lambda each: each.explained)
        out.append(start)
    return tuple(out)
