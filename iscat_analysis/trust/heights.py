"""Spread of the heights of particles, and the mass error of holding them at one height."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.config import Config
from iscat_analysis.inference.heights import HeightSpread, has_prior, spread_of_heights
from iscat_analysis.inference.nuisances import Evidence
from iscat_analysis.records import FloatArray, Status, has_only

_DESCRIBED = frozenset({Status.OK.value, Status.POOR_FIT.value})
"""Verdicts with which a height can still be read; a height that is held makes fits poor itself."""


@dataclass(frozen=True)
class Heights:
    """Heights that the light of all events shows, and the mass shifts that follow."""

    spread: HeightSpread
    held: bool
    mass_shift_kda: FloatArray  # of every row, where heights are held and are not equal
    learned_optics: bool

    @classmethod
    def of(cls, config: Config, table: pd.DataFrame, evidence: Evidence) -> Heights | None:
        """Estimate the heights from all rows; None where there are too few."""
        held = not has_prior(config)
        kinds = _DESCRIBED if held else frozenset({Status.OK.value})
        good = has_only(table, kinds)
        spread = spread_of_heights(evidence.z_nm[good], evidence.sigma_z_nm[good])
        if spread is None:
            return None
        shift = np.zeros(len(table))
        if held and spread.is_spread:
            off = math.hypot(spread.sd_nm, spread.mean_nm - config.particle.nominal_height_nm)
            shift = np.abs(np.nan_to_num(evidence.mass_per_z)) * off
        return cls(spread, held, shift, config.optics.are_learned)

    @property
    def are_wrong(self) -> bool:
        """Whether one height is held although the particles have different heights."""
        return self.held and self.spread.is_spread

    @property
    def message(self) -> str:
        """Message for the user; empty where heights and errors agree."""
        if not self.are_wrong:
            return ""
        return (
            f"the particles are not equally high: {self.spread} where one height is held; their "
            "masses are wrong by what systematic_mass_kda says, and the fits of many are poor; "
            'particle.height_nm = "auto" learns mean and spread and fits every height'
        )

    @property
    def summary(self) -> Mapping[str, Any]:
        """What ``summary.json`` says."""
        spread = self.spread
        return {
            "mean_nm": spread.mean_nm,
            "mean_se_nm": spread.mean_se_nm,
            "sd_nm": spread.sd_nm,
            "sd_ci95_nm": [spread.sd_low_nm, spread.sd_high_nm],
            "events": spread.events,
            "held": self.held,
            "mean_is_of_learned_optics": self.learned_optics,
        }
