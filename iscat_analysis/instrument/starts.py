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
from scipy import fft

from iscat_analysis.instrument.joint_fit import Estimate, maximise
from iscat_analysis.instrument.particle_image import (
    FARTHEST_CENTRE_PX,
    UNIT_KDA,
    Build,
    ParticleImage,
    best_amplitudes,
    contrast_of,
)
from iscat_analysis.optics.parameters import PRIMARY, SECONDARY, Prior, Settings, free_names
from iscat_analysis.records import FloatArray, Mapper

FOCUS_RANGE_NM = 1000.0
"""How far from the configured focus the search goes."""

FOCUS_STEP_NM = 80.0
"""Step of the search over focus; a quarter of the depth of field at NA 1.2."""
_LOOKED_FOR = ("focus_nm", "reference_phase_deg")
_TURNS = 24  # of half a circle of phases, for strong particles
_FAINT = 1e-3  # share of what is explained below which the scattered light alone is left out
_DIRECTIONS_DEG = (45.0, 90.0, 135.0)


@dataclass(frozen=True)
class Start:
    """A microscope that resembles the average picture."""

    values: Mapping[str, Any]
    x_nm: float
    y_nm: float
    mass_kda: float
    explained: float


def _quadratures(model: Any, image: ParticleImage) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Contrast per mass at reference phases 0 and 90°, and scattered light per squared mass.

    The particle is in the centre.
    """
    pixels = model.pixels(image.grid)
    along, power = np.zeros(image.grid.shape, complex), np.zeros(image.grid.shape)
    for down, high in zip(pixels.offsets, pixels.weights, strict=True):
        for right, wide in zip(pixels.offsets, pixels.weights, strict=True):
            dx, dy = np.meshgrid(pixels.x + right, pixels.y + down)
            field = model.field(dx, dy, image.z_nm, UNIT_KDA) / UNIT_KDA
            along += wide * high * field[0]
            power += wide * high * np.sum(np.abs(field) ** 2, axis=0)
    return 2 * along.real, 2 * along.imag, power


def search_starts(
    averages: Sequence[ParticleImage],
    build: Build,
    candidates: Sequence[Mapping[str, Any]],
    *,
    most: int,
    prior: Prior | None = None,
) -> tuple[Start, ...]:
    """Rank microscopes by what they explain of the average pictures, and how likely they are."""
    pixel, shape = averages[0].grid.pixel_nm, averages[0].grid.shape
    spectra = []
    for average in averages:
        contrast, variance = contrast_of(average)
        spectra.append((fft.rfft2(contrast), float(np.median(variance))))
    reach = math.ceil(FARTHEST_CENTRE_PX / 2)
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

    def likely(start: Start) -> float:
        return start.explained + 2 * (prior.log_density(start.values, _LOOKED_FOR) if prior else 0)

    found.sort(key=likely, reverse=True)
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
    turns = np.concatenate(
        [np.pi * np.arange(_TURNS)[:, None, None] / _TURNS * np.ones_like(phase), phase[None]]
    )
    way = np.stack([np.cos(turns), np.sin(turns)])
    tried, gained = best_amplitudes(
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


_STARTS = 2  # microscopes that are refined, per state
_FIRST_PASSES, _MORE_PASSES = 6, 10  # of all starts, and of those that lead then
_LEADERS = 2  # beside the best of every state
_ROUGH = 1.0  # gain in log-likelihood that ends a search
_HOPELESS = 0.03  # share of the log-likelihood by which a state lags that is given up
_WORTH_A_MASK = 1.01  # times what the same light explains without one
_MASKS_NA = (0.35, 0.65)
_FINER_MASKS_NA = (0.35, 0.5, 0.65, 0.8, 1.0)
_MASK_TRANSMITS = 0.3  # where no attenuation is configured
_FINER_TRANSMITS = (0.3, 0.75)


def same_state(one: Estimate, other: Estimate) -> bool:
    """Tell whether two microscopes have the same polarisation, and both a mask or none."""
    return _state(one.values) == _state(other.values)


def _state(values: Settings) -> tuple[str, bool]:
    return str(values["polarization"]), bool(values["mask_na"] > 0)


@dataclass(frozen=True)
class StateSearch:
    """Search for the kind of microscope; `run` does it."""

    configured: Settings
    build: Build
    free: tuple[str, ...]
    limits: Mapping[str, tuple[float, float]]
    prior: Prior
    mapper: Mapper = map

    def run(self, averages: Sequence[ParticleImage]) -> list[Estimate]:
        """Refine the most promising microscopes."""
        found = list(self.mapper(lambda state: self._begin(averages, state), self.states()))
        begun = [start for starts in found for start in starts if self._promising(start, found)]
        refined = self._refine(averages, begun)
        hidden = self._hidden_masks(averages, refined)
        refined += self._refine(averages, hidden, refined) if hidden else []
        return sorted(refined, key=lambda e: -e.log_posterior)

    def states(self) -> list[list[dict[str, Any]]]:
        """Give the settings to start from, those of one state together."""
        now = dict(self.configured)
        lights = ["linear", "circular"] if "polarization" in self.free else [now["polarization"]]
        masks: list[list[dict[str, Any]]] = [[{}]]
        if "mask" in self.free:
            dims = now["attenuation"] if now["attenuation"] < 0.9 else _MASK_TRANSMITS
            edges = sorted({*_MASKS_NA, *([now["mask_na"]] if now["mask_na"] else [])})
            masks = [
                [{"mask_na": 0.0, "attenuation": now["attenuation"]}],
                [{"mask_na": edge, "attenuation": dims} for edge in edges],
            ]
        foci = [now["focus_nm"]]
        if "focus" in self.free:
            steps = math.ceil(FOCUS_RANGE_NM / FOCUS_STEP_NM)
            foci = [now["focus_nm"] + FOCUS_STEP_NM * i for i in range(-steps, steps + 1)]
        return [
            [
                {**now, **mask, "polarization": light, "focus_nm": focus}
                for mask in kind
                for focus in foci
            ]
            for light in lights
            for kind in masks
        ]

    def _begin(
        self,
        averages: Sequence[ParticleImage],
        candidates: Sequence[Mapping[str, Any]],
        most: int = _STARTS,
    ) -> tuple[Start, ...]:
        starts = search_starts(averages, self.build, candidates, most=most, prior=self.prior)
        if "polarization" in self.free:
            starts = turned_starts(averages, self.build, starts)
        return starts if "phase" in self.free else tuple(map(self._phased, starts))

    def _promising(self, start: Start, found: Sequence[Sequence[Start]]) -> bool:
        """Whether a mask that is not configured explains more than the same light without one."""
        if not start.values["mask_na"] or self.configured["mask_na"]:
            return True
        light = start.values["polarization"]
        plain = [
            other.explained
            for others in found
            for other in others
            if other.values["polarization"] == light and not other.values["mask_na"]
        ]
        return start.explained > _WORTH_A_MASK * max(plain)

    def _phased(self, start: Start) -> Start:
        """Put the configured reference phase back."""
        phase = self.configured["reference_phase_deg"]
        flipped = math.cos(math.radians(start.values["reference_phase_deg"] - phase)) < 0
        mass = -start.mass_kda if flipped else start.mass_kda
        return replace(start, values={**start.values, "reference_phase_deg": phase}, mass_kda=mass)

    def _refine(
        self,
        averages: Sequence[ParticleImage],
        begun: Sequence[Start],
        known: Sequence[Estimate] = (),
    ) -> list[Estimate]:
        """Fit the averages from every start, and go on with those that lead after a few passes.

        What is behind a known microscope of the same light is left out.
        """

        def first(start: Start) -> Estimate:
            there = [
                replace(a, x_nm=start.x_nm, y_nm=start.y_nm, mass_kda=start.mass_kda)
                for a in averages
            ]
            return self._fit(there, start.values, _FIRST_PASSES)

        def more(fit: Estimate) -> Estimate:
            return fit if fit.converged else self._fit(fit.images, fit.values, _MORE_PASSES)

        fits = sorted(self.mapper(first, begun), key=lambda e: -e.log_posterior)
        fits = [
            fit
            for fit in fits
            if not any(
                fit.values["polarization"] == other.values["polarization"]
                and fit.log_posterior < other.log_posterior
                for other in known
            )
        ]
        leading = [
            fit
            for rank, fit in enumerate(fits)
            if rank < _LEADERS
            or (
                not any(same_state(fit, better) for better in fits[:rank])
                and fit.log_posterior > (1 - _HOPELESS) * fits[0].log_posterior
            )
        ]
        return list(self.mapper(more, leading))

    def _fit(self, images: Sequence[ParticleImage], start: Settings, passes: int) -> Estimate:
        names = free_names(self.free, start, PRIMARY + SECONDARY)
        return maximise(
            images, self.build, start, names,
            prior=self.prior, limits=self.limits, tolerance=_ROUGH, passes=passes,
        )  # fmt: skip

    def _hidden_masks(
        self, averages: Sequence[ParticleImage], refined: Sequence[Estimate]
    ) -> list[Start]:
        """Begin with a mask in every refined pupil that has none."""
        if "mask" not in self.free:
            return []
        top = max(fit.log_posterior for fit in refined)
        plain = [
            fit
            for fit in refined
            if not fit.values["mask_na"] and fit.log_posterior > (1 - _HOPELESS) * top
        ]
        begun = self.mapper(
            lambda fit: self._begin(
                averages,
                [
                    {**fit.values, "mask_na": edge, "attenuation": dim}
                    for edge in _FINER_MASKS_NA
                    for dim in _FINER_TRANSMITS
                    if edge < fit.values["na"] - 0.1
                ],
                most=1,
            ),
            plain,
        )
        return [start for starts in begun for start in starts]
