"""Results of photon transfer: numbers with standard errors, curves, masks, a verdict."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pandas as pd

from iscat_analysis.records import BoolArray, FloatArray

_Z95 = 1.959964


@dataclass(frozen=True)
class Estimate:
    """A number and how well it is known."""

    value: float
    se: float

    @property
    def ci95(self) -> tuple[float, float]:
        """Central 95 % confidence interval."""
        return self.value - _Z95 * self.se, self.value + _Z95 * self.se


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """What the noise says of a camera; `measure_camera` makes it."""

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
        """Give what ``camera.json`` holds."""

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
        """Write the section ``[camera]`` to paste into a configuration."""
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
