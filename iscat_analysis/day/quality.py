"""Quality of each movie of a batch: numbers, and warnings in words."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from iscat_analysis.config import Config
from iscat_analysis.day.calibrate import Day
from iscat_analysis.day.plan import Movie
from iscat_analysis.records import FloatArray
from iscat_analysis.units import count

SMALL_P = 0.01
"""A p-value below which a fit is counted as poor."""

MOST_SMALL_P_SHARE = 0.1
"""Share of small p-values, ten times the expected one, above which the model is doubted."""

LARGEST_NOISE_RATIO = 1.5
"""Noise over that of the photoelectrons, as a variance, that is told."""

FAR_PX = 1.0
"""Drift of the fixed pattern that is told [px]."""

FEW_EVENTS = 10
"""Fewer events tell no species."""

MOST_OUTSIDE_SHARE = 0.1
"""Share of the masses beyond the standards that is told."""

NEAR_STANDARD = 0.05
"""Relative distance within which a species is a standard, where its interval is narrower."""


def noise_of(summary: Mapping[str, Any]) -> tuple[float | None, int | None]:
    """Find the noise at the length of the movie's windows."""
    noise = summary.get("landing") or summary.get("background") or {}
    frames, values = noise.get("noise_frames"), noise.get("noise_variance_over_shot")
    known = [(n, v) for n, v in zip(frames or (), values or (), strict=True) if v is not None]
    window = noise.get("window_frames", math.inf)
    fitting = [(n, v) for n, v in known if n <= window] or known[:1]
    return (float(fitting[-1][1]), int(fitting[-1][0])) if fitting else (None, None)


def judge(
    movie: Movie,
    summary: Mapping[str, Any],
    config: Config | None,
    masses_kda: FloatArray,
    p_values: FloatArray,
    day: Day,
) -> dict[str, Any]:
    """Describe the quality of one movie.

    Shapes: `masses_kda` (n,), `p_values` (n,).
    """
    cautions: list[str] = []
    noise, frames = noise_of(summary)
    if noise is not None and noise > LARGEST_NOISE_RATIO:
        cautions.append(f"noise {noise:.2g} times shot noise at {frames} frames")
    landing = summary.get("landing") or summary.get("background") or {}
    drift = landing.get("drift_px")
    moved = float(np.hypot(*drift)) if drift and None not in drift else None
    if moved is not None and moved > FAR_PX and not landing.get("drift_corrected"):
        cautions.append(f"the pattern drifts {moved:.1f} px")
    small = float(np.mean(p_values < SMALL_P)) if p_values.size else None
    if small is not None and small > MOST_SMALL_P_SHARE and p_values.size >= FEW_EVENTS:
        cautions.append(f"{100 * small:.0f} % of p-values below {SMALL_P:g}")
    if summary.get("repeats", {}).get("understated"):
        cautions.append("σ is smaller than the measured spread")
    if summary["events"] < FEW_EVENTS and movie.row.role != "blank":
        cautions.append(f"{count(summary['events'], 'event')}, too few for species")
    optics, focus = _optics(summary, config, day)
    if optics.startswith(("learned from this", "rejected")):
        cautions.append(f"optics {optics}")
    scale = _scale(summary, config, day)
    if "mass" in dict(day.failed) and scale.startswith("as configured"):
        cautions.append("mass scale as configured, because the day's calibration failed")
    if scale.startswith(("none", "another")):
        cautions.append(f"mass scale: {scale}")
    outside = _outside(masses_kda, day)
    if outside is not None and outside > MOST_OUTSIDE_SHARE and masses_kda.size >= FEW_EVENTS:
        low, high = min(day.standards_kda), max(day.standards_kda)
        cautions.append(
            f"{100 * outside:.0f} % of masses are beyond the standards, {low:g} to {high:g} kDa"
        )
    seen = _standards_seen(movie, summary, day)
    if seen and seen[0] < seen[1]:
        cautions.append(f"{seen[0]} of {count(seen[1], 'standard')} among the species")
    precision = summary.get("precision", {}).get("mass_kda", {})
    return {
        "cautions": "; ".join(cautions),
        "drift_px": moved,
        "focus_shift_nm": focus,
        "median_p_value": float(np.median(p_values)) if p_values.size else None,
        "small_p_values": small,
        "repeat_over_crb": precision.get("repeat_over_crb"),
        "standards_seen": f"{seen[0]} of {seen[1]}" if seen else "",
        "optics": optics,
        "mass_scale": scale,
        "outside_standards": outside,
    }


def _optics(
    summary: Mapping[str, Any], config: Config | None, day: Day
) -> tuple[str, float | None]:
    """Say where the optics are from, and by how much the focus was moved."""
    optics = summary.get("optics")
    source = "of the day" if day.settings.get("optics.focus_nm") is not None else "as configured"
    if config is not None and config.optics.file is not None:
        source = "of a file"
    if not optics:
        return f"{source}, not tested", None
    if optics.get("calibrated") and config is not None:
        reference = day.settings.get("optics.focus_nm")
        shift = None if reference is None else config.optics.focus_nm - float(reference)
        return "learned from this movie", shift
    if "tested" not in optics:
        return f"{source}, too few bright particles to test them", None
    if optics.get("reason"):
        return f"rejected by this movie ({source}), and not learned", None
    return f"{source}, confirmed", None


def _scale(summary: Mapping[str, Any], config: Config | None, day: Day) -> str:
    """Say where the mass scale is from."""
    used = config.calibration if config is not None else None
    if summary["mass_scale"] != "calibration" or used is None:
        return "none: the model's own"
    line = day.settings.get("calibration")
    if line is None:
        return "as configured, not of this day"
    same = math.isclose(used.gradient_per_kda, line["gradient_per_kda"])
    return "of the day" if same else "another line than the day's"


def _outside(masses_kda: FloatArray, day: Day) -> float | None:
    if not day.standards_kda or not masses_kda.size:
        return None
    size = np.abs(masses_kda)
    low, high = min(day.standards_kda), max(day.standards_kda)
    # The events of a standard scatter about its mass: up to a tenth beyond counts as inside.
    return float(np.mean((size < 0.9 * low) | (size > 1.1 * high)))


def _standards_seen(movie: Movie, summary: Mapping[str, Any], day: Day) -> tuple[int, int] | None:
    """Count the standards of a calibrant that are among its species."""
    wanted = [mass for mass, _ in movie.row.standards] or list(day.standards_kda)
    described = summary.get("distribution")
    if movie.row.role != "calibrant" or not day.standards_kda or not described:
        return None
    species = [s for s in described["species"] if not s["outlier"]]
    seen = 0
    for mass in wanted:
        for each in species:
            reach = max(NEAR_STANDARD * mass, 3 * (each["mass_se"] or 0.0))
            if abs(each["mass_kda"] - mass) <= reach:
                seen += 1
                break
    return seen, len(wanted)
