"""Which kind of microscope, on the average picture: polarisation, mask or none, side of focus.

Every kind is tried over all foci, in a pupil without aberrations; the most promising starts are
refined with the aberrations that a pupil usually has.  A mask hides well behind them: it is looked
for a second time in the refined pupils, where only its edge and its transmission are missing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from iscat_analysis.instrument.learner.estimate import Estimate, maximise
from iscat_analysis.instrument.learner.particle_images import Build, ParticleImage, Settings
from iscat_analysis.instrument.learner.settings import PRIMARY, SECONDARY, free_names
from iscat_analysis.instrument.learner.starts import (
    FOCUS_RANGE_NM,
    FOCUS_STEP_NM,
    Start,
    search_starts,
    turned_starts,
)
from iscat_analysis.records import Mapper

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
    mapper: Mapper = map

    def run(self, averages: Sequence[ParticleImage]) -> list[Estimate]:
        """Refine the most promising microscopes."""
        found = list(self.mapper(lambda state: self._begin(averages, state), self.states()))
        begun = [start for starts in found for start in starts if self._promising(start, found)]
        refined = self._refine(averages, begun)
        hidden = self._hidden_masks(averages, refined)
        refined += self._refine(averages, hidden, refined) if hidden else []
        return sorted(refined, key=lambda e: -e.log_likelihood)

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
        starts = search_starts(averages, self.build, candidates, most=most)
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
            return fit if fit.converged else self._fit(fit.sights, fit.values, _MORE_PASSES)

        fits = sorted(self.mapper(first, begun), key=lambda e: -e.log_likelihood)
        fits = [
            fit
            for fit in fits
            if not any(
                fit.values["polarization"] == other.values["polarization"]
                and fit.log_likelihood < other.log_likelihood
                for other in known
            )
        ]
        leading = [
            fit
            for rank, fit in enumerate(fits)
            if rank < _LEADERS
            or (
                not any(same_state(fit, better) for better in fits[:rank])
                and fit.log_likelihood > (1 - _HOPELESS) * fits[0].log_likelihood
            )
        ]
        return list(self.mapper(more, leading))

    def _fit(self, sights: Sequence[ParticleImage], start: Settings, passes: int) -> Estimate:
        names = free_names(self.free, start, PRIMARY + SECONDARY)
        return maximise(
            sights, self.build, start, names, limits=self.limits, tolerance=_ROUGH, passes=passes
        )

    def _hidden_masks(
        self, averages: Sequence[ParticleImage], refined: Sequence[Estimate]
    ) -> list[Start]:
        """Begin with a mask in every refined pupil that has none."""
        if "mask" not in self.free:
            return []
        top = max(fit.log_likelihood for fit in refined)
        plain = [
            fit
            for fit in refined
            if not fit.values["mask_na"] and fit.log_likelihood > (1 - _HOPELESS) * top
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
