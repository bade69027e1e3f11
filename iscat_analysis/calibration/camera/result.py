"""What photon transfer gives: numbers with standard errors, curves, masks, a verdict."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pandas as pd

from iscat_analysis.records import BoolArray, FloatArray

_Z95 = 1.959964


@dataclass(frozen=True)
class Estimate:
    """A number and how well it is known.

    Attributes
    ----------
    value, se : float
        Estimate and standard error, in the same unit.
    """

    value: float
    se: float

    @property
    def ci95(self) -> tuple[float, float]:
        """Central 95 % confidence interval."""
        return self.value - _Z95 * self.se, self.value + _Z95 * self.se


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """What the noise says of a camera; `measure_camera` makes it.

    Attributes
    ----------
    gain_e_per_adu : Estimate or None
        Photoelectrons per count [e/count]; None from a dark alone.
    offset_adu : Estimate
        Counts in the dark [counts]; where `offset_from` is ``"line"`` it is o − σ_r²/g.
    offset_from : str
        ``"dark"``, ``"given"``, ``"flicker"`` or ``"line"``.
    read_noise_adu : Estimate or None
        Standard deviation per frame, rounding included [counts]; None where not identifiable.
    read_noise_e : Estimate or None
        The same [e].
    read_noise_below_e : float or None
        95 % upper limit where the read noise is too small to be seen [e].
    curve : pandas.DataFrame
        Photon-transfer curve: mean_adu, variance_adu2, variance_se, fit_adu2, pixels.
    noise : pandas.DataFrame
        Noise against averaging: n_frames, contrast_noise, contrast_noise_se, shot_noise, excess
        (noise variance over shot-noise variance), excess_se, comparisons.
    shot_limited_frames : int or None
        Longest average whose noise is shot noise; 0 for none, None where it cannot be told.
    verdict : str
        The same in one sentence.
    masked : dict of str to ndarray of bool, shape (y, x)
        ``"saturated"``, ``"clipped"`` (at zero counts, where noise is cut off), ``"dead"``,
        ``"hot"`` (bright or noisy beyond its neighbours).
    maps : dict of str to ndarray, shape (y, x)
        As far as the recordings give them and they were asked for: ``"gain_e_per_adu"``,
        ``"offset_adu"``, ``"read_noise_e"``.
    frames : int
        Frames of light that were used.
    notes : tuple of str
        What the user should know, one sentence each.
    """

    gain_e_per_adu: Estimate | None
    offset_adu: Estimate
    offset_from: str
    read_noise_adu: Estimate | None
    read_noise_e: Estimate | None
    read_noise_below_e: float | None
    curve: pd.DataFrame
    noise: pd.DataFrame
    shot_limited_frames: int | None
    verdict: str
    masked: dict[str, BoolArray]
    maps: dict[str, FloatArray]
    frames: int
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Give what ``camera.json`` holds.

        Returns
        -------
        dict
            Nested plain values, the curves by column; maps are left out.
        """

        def plain(estimate: Estimate | None) -> dict[str, Any] | None:
            if estimate is None:
                return None
            return {"value": estimate.value, "se": estimate.se, "ci95": list(estimate.ci95)}

        return {
            "gain_e_per_adu": plain(self.gain_e_per_adu),
            "offset_adu": plain(self.offset_adu),
            "offset_from": self.offset_from,
            "read_noise_adu": plain(self.read_noise_adu),
            "read_noise_e": plain(self.read_noise_e),
            "read_noise_below_e": self.read_noise_below_e,
            "shot_limited_frames": self.shot_limited_frames,
            "verdict": self.verdict,
            "frames": self.frames,
            "masked_pixels": {name: int(mask.sum()) for name, mask in self.masked.items()},
            "photon_transfer": self.curve.to_dict("list"),
            "noise": self.noise.to_dict("list"),
            "notes": list(self.notes),
        }

    def to_toml(self, maps: dict[str, str] | None = None) -> str:
        """Write the section ``[camera]`` to paste into a configuration.

        Parameters
        ----------
        maps : dict of str to str, optional
            Paths of maps, by key, to name in place of the numbers.

        Returns
        -------
        str
            TOML text; a value that is not known is left out.
        """
        lines = ["[camera]"]
        for key, estimate in (
            ("gain_e_per_adu", self.gain_e_per_adu),
            ("offset_adu", self.offset_adu),
            ("read_noise_e", self.read_noise_e),
        ):
            if estimate is None:
                continue
            low, high = estimate.ci95
            value = f'"{maps[key]}"' if maps and key in maps else f"{estimate.value:.6g}"
            interval = f"95 %: {low:.6g} to {high:.6g}" if low < high else "as given"
            lines.append(f"{key} = {value}  # {interval}")
        return "\n".join(lines) + "\n"
