"""The measured spread: of each event, and pooled as a ratio to the bound."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.inference.repeats import BLOCK_ROWS, EmpiricalSpread, pooled
from iscat_analysis.records import FREE_PARAMETERS, REPEAT_COLUMNS, FloatArray, Status, has_only
from iscat_analysis.search.empty import EmptySpread

_NOISE_SHOWS = frozenset(
    {Status.OK.value, Status.POOR_FIT.value, Status.CHANGING.value, Status.EXTENDED.value}
)
"""Verdicts with which the noise can still be read; excess noise itself makes fits poor."""


_SHARE = 0.3  # of an excess that is worth naming


def measure_spread(
    mode: str, table: pd.DataFrame, repeats: Sequence[FloatArray], empty: EmptySpread | None
) -> dict[str, EmpiricalSpread]:
    """Pool the spread of all events that are ok, or flagged as a poor fit only."""
    shows = has_only(table, _NOISE_SHOWS).tolist()
    kept = [repeat for repeat, good in zip(repeats, shows, strict=True) if good]
    if not kept:
        return {}
    own = np.stack(kept)[:, :BLOCK_ROWS]
    found: dict[str, EmpiricalSpread] = {}
    for k, name in enumerate(FREE_PARAMETERS[mode]):
        if empty is None:
            one = pooled(own[:, :, [k, -1]], None, None)
        else:
            one = pooled(
                own[:, :, [k, -1]], empty.squares[:, k], empty.counts,
                shared=float(empty.shared[k]), distances=empty.distances,
            )  # fmt: skip
        if one is not None:
            found[name] = one
    return found


def repeat_columns(
    mode: str, table: pd.DataFrame, repeats: Sequence[FloatArray]
) -> dict[str, FloatArray]:
    """Make the columns ``repeat_*``: the error of each event from parts of its own frames."""
    columns = {name: np.full(len(table), np.nan) for name in REPEAT_COLUMNS}
    for k, name in enumerate(FREE_PARAMETERS[mode]):
        squares, counts = (np.array([r[0, i] for r in repeats], dtype=float) for i in (k, -1))
        with np.errstate(divide="ignore", invalid="ignore"):
            spread = np.sqrt(squares / counts)
        columns[f"repeat_{name}"] = table[f"crb_{name}"].to_numpy(float) * spread
    return columns


def measured_scale(found: Mapping[str, EmpiricalSpread]) -> dict[str, float]:
    """Factor of σ with ``fit.sigma = "measured"``: the spread over the bound."""
    return {f"sigma_{name}": max(a.over_crb, 1.0) for name, a in found.items()}


def spread_verdict(
    found: Mapping[str, EmpiricalSpread],
    noise: Mapping[str, Any],
    *,
    scaled: bool,
    rejected: bool = False,
    sliding: bool = True,
) -> dict[str, Any]:
    """Say whether σ is too small, by what factor, and the likely kind of noise."""
    high = {name: a for name, a in found.items() if a.exceeds}
    low = {name: a for name, a in found.items() if a.falls_short}
    if not high:
        message = ""
        if low:
            message = (
                f"the measured spread is {_ratios(low)} times the Cramér–Rao bound: there is less "
                "noise than the camera's numbers say, look at camera.gain_e_per_adu and "
                "camera.read_noise_e"
            )
        return {"understated": False, "message": message, "cause": ""}
    worst = max(high.values(), key=lambda a: a.significance)
    cause = likely_noise(worst, noise, rejected=rejected, sliding=sliding)
    if scaled:
        message = (
            f"σ is scaled by the measured spread, {_ratios(high)} times the Cramér–Rao bound; "
            f"{cause}"
        )
    else:
        message = (
            f"σ is too small: the measured spread is {_ratios(high)} times the Cramér–Rao bound; "
            f'{cause}; fit.sigma = "measured" scales σ by it'
        )
    return {"understated": not scaled, "message": message, "cause": cause}


def likely_noise(
    found: EmpiricalSpread,
    noise: Mapping[str, Any],
    *,
    rejected: bool = False,
    sliding: bool = True,
) -> str:
    """Name what an excess of noise looks like.

    Notes
    -----
    In units of the bound's variance, noise from frame to frame is the same at every length, and
    slower noise grows with it; that of single frames grows with the time since the background.
    """
    excess = found.over_crb**2 - 1
    single = found.fast2
    causes, doubt = [], ""
    if single - 1 > _SHARE * excess:
        over_shot = [v for v in noise.get("noise_variance_over_shot", ()) if v is not None]
        pixels = over_shot[0] if over_shot else single
        if abs(pixels - 1) > _SHARE * (single - 1):
            causes.append(
                f"single frames have {single:.3g} times the variance that the camera's numbers "
                "give: a wrong camera.gain_e_per_adu, or a source or camera with noise of its own"
            )
        else:
            causes.append(
                "the noise of single pixels is as expected but that of an image is not: "
                "neighbouring pixels are correlated, by crosstalk or a filter in the camera"
            )
    if found.empty:
        if found.slow2 > _SHARE * excess:
            causes.append(_slow(found, sliding))
            if rejected:
                doubt = (
                    "it may be what a wrong model of the image leaves over of other particles: "
                    "check focus, NA and pixel size first; otherwise "
                )
        own = found.over_crb**2 - found.empty[-1] ** 2
        if own > _SHARE * excess:
            causes.append(
                "it is larger at the particles than elsewhere: they move or change in the light"
            )
    return doubt + ("; ".join(causes) or "its kind is not clear")


def _slow(found: EmpiricalSpread, sliding: bool) -> str:
    name = "a drift of the fixed pattern (speckle)" if found.drifts else "flicker (1/f noise)"
    if found.single:
        return (
            f"it grows with the time since the background, as {name}: take background frames "
            "nearer to the others (background.frames), or fewer of these (fit.frames)"
        )
    remedy = ": average fewer"
    if found.drifts and sliding:
        remedy = ": set background.drift_correction = true, or average fewer"
    elif found.drifts:  # the correction is for windows that slide
        remedy = (
            ": take background frames nearer to the others (background.frames), or average fewer"
        )
    return f"it grows with the frames that are averaged, as {name}{remedy}"


def _ratios(found: Mapping[str, EmpiricalSpread]) -> str:
    names = {"x_nm": "x", "y_nm": "y", "z_nm": "z", "mass_kda": "mass"}
    parts = [
        f"{a.over_crb:.2f} ({a.ci95[0]:.2f} to {a.ci95[1]:.2f}) in {names[name]}"
        for name, a in found.items()
    ]
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
