"""Checks of the rows of a movie by what all its events tell together, in a registry.

A fit knows the error of its own likelihood.  Each check says what it needs, and gives the rows with
flags, masses or errors changed, and a finding.  The measured spread of events, pooled as a ratio to
the bound, is what they begin with.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from iscat_analysis.findings import Finding
from iscat_analysis.findings.optics import LESS_NOISE, SCALED_SIGMA, UNDERSTATED_SIGMA
from iscat_analysis.fitting.results import DetectionResult
from iscat_analysis.inference.nuisances import Evidence
from iscat_analysis.inference.repeats import BLOCK_ROWS, EmpiricalSpread, pooled
from iscat_analysis.records import (
    FREE_PARAMETERS,
    REPEAT_COLUMNS,
    BoolArray,
    FloatArray,
    Status,
    flagged,
    has_only,
)
from iscat_analysis.search.empty import EmptySpread
from iscat_analysis.trust.changing_light import (
    Fluctuation,
    at_a_shared_place,
    in_parts,
    may_rise,
    slow_landings,
)
from iscat_analysis.trust.extension import Extension, Heights, told_as_pairs, with_masses_of_pairs

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
        mine = own[:, :, [k, -1]]
        if empty is None:
            one = pooled(mine, None, None)
        else:
            shared, squares = float(empty.shared[k]), empty.squares[:, k]
            one = pooled(mine, squares, empty.counts, shared=shared, distances=empty.distances)
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


def spread_verdict(
    found: Mapping[str, EmpiricalSpread],
    noise: Mapping[str, Any],
    *,
    scaled: bool,
    rejected: bool = False,
    sliding: bool = True,
) -> tuple[dict[str, Any], Finding | None]:
    """Say whether σ is too small, by what factor, and the likely kind of noise.

    Gives the section ``repeats`` of ``summary.json`` and the finding.
    """
    high = {name: a for name, a in found.items() if a.exceeds}
    low = {name: a for name, a in found.items() if a.falls_short}
    cause, finding = "", None
    if high:
        worst = max(high.values(), key=lambda a: a.significance)
        cause = likely_noise(worst, noise, rejected=rejected, sliding=sliding)
        kind = SCALED_SIGMA if scaled else UNDERSTATED_SIGMA
        finding = kind({"ratios": _ratios(high), "cause": cause})
    elif low:
        finding = LESS_NOISE({"ratios": _ratios(low)})
    message = "" if finding is None else finding.text
    return {"understated": bool(high) and not scaled, "message": message, "cause": cause}, finding


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


@dataclass(frozen=True)
class Checked:
    """The rows of a movie, and what the checks so far found of them.

    Shapes: `shared_place` (rows,), steps that may be changes of another particle's light.
    """

    found: DetectionResult
    fits: pd.DataFrame
    achieved: Mapping[str, EmpiricalSpread]
    evidence: Evidence
    shared_place: BoolArray
    heights: Heights | None = None
    extension: Extension | None = None
    fluctuation: Fluctuation | None = None
    findings: tuple[Finding, ...] = ()

    @property
    def of_landings(self) -> bool:
        """Whether the rows are steps of a landing movie."""
        return self.found.context.config.background.slides

    @property
    def has_evidence(self) -> bool:
        """Whether the light of events beside their fits is known."""
        return self.evidence.z_nm.size > 0

    @property
    def sections(self) -> dict[str, Mapping[str, Any]]:
        """Sections of ``summary.json``."""
        results = {name: getattr(self, name) for name in ("heights", "extension", "fluctuation")}
        return {name: result.summary for name, result in results.items() if result is not None}

    @property
    def shifts_kda(self) -> dict[str, FloatArray]:
        """Errors of all masses that follow from what fits hold."""
        results = {"heights": self.heights, "extension": self.extension}
        return {name: r.mass_shift_kda for name, r in results.items() if r is not None}

    @property
    def has_wrong_heights(self) -> bool:
        """Whether one height is held of particles at several, which look like wide ones."""
        return self.heights is not None and self.heights.are_wrong

    @property
    def scale(self) -> dict[str, float]:
        """Factors of σ, which then has all that frames show; none if it is of the likelihood."""
        measured = self.found.context.config.fit.sigma == "measured"
        return measured_scale(self.achieved) if measured else {}

    def flag(self, status: Status, which: BoolArray) -> Checked:
        """Flag rows.

        Shapes: `which` (rows,).
        """
        return replace(self, fits=flagged(self.fits, status, which))

    def saying(self, finding: Finding | None) -> Checked:
        """Keep a finding."""
        return self if finding is None else replace(self, findings=(*self.findings, finding))


class Check(NamedTuple):
    """One check."""

    name: str
    needs: Callable[[Checked], bool]
    run: Callable[[Checked], Checked]


def _with_heights(state: Checked) -> Checked:
    found = Heights.of(state.found.context.config, state.fits, state.evidence)
    return state if found is None else replace(state, heights=found).saying(found.finding)


def _with_extension(state: Checked) -> Checked:
    config, fits = state.found.context.config, state.fits
    found = Extension.of(config, fits, state.evidence, state.achieved)
    if found is None:
        return state
    if config.fit.pairs:
        paired = told_as_pairs(fits, found)
        fits, found = with_masses_of_pairs(fits, paired), found.without(paired)
    state = replace(state, fits=fits, extension=found).saying(found.finding)
    return state.flag(Status.EXTENDED, found.flagged)


def _with_changing_light(state: Checked) -> Checked:
    shared = at_a_shared_place(state.fits, state.found.context.config.optics.resolution_nm)
    return replace(state, shared_place=shared).flag(Status.CHANGING, shared)


def _with_rises(state: Checked) -> Checked:
    rises, shared = state.evidence.rise_frames, state.shared_place
    parts = in_parts(state.fits, rises)
    state = state.flag(Status.CHANGING, parts)
    unseen, frames = may_rise(state.fits, state.evidence, shared)
    rising = int((~shared & (np.nan_to_num(rises) > 0)).sum())
    said = slow_landings(frames, int(unseen.sum()), rising, len(state.fits))
    return replace(state.flag(Status.CHANGING, unseen), shared_place=shared | parts).saying(said)


def _with_fluctuation(state: Checked) -> Checked:
    found, shared = state.found, state.shared_place
    result = Fluctuation.of(found.context.mode, found.fits, found.repeats, state.achieved, shared)
    if result is None:
        return state
    if state.of_landings and result.is_seen:
        wide = at_a_shared_place(
            state.fits, state.found.context.config.optics.resolution_nm, result.relative
        )
        state = state.flag(Status.CHANGING, wide)
    sigma = np.sqrt(state.fits["sigma_mass_kda"] ** 2 + result.variance_kda2)
    fits = state.fits.assign(sigma_mass_kda=sigma)
    return replace(state, fits=fits, fluctuation=result).saying(result.finding)


CHECKS = (
    Check("heights", lambda state: state.has_evidence, _with_heights),
    Check("extension", lambda state: state.has_evidence and not state.has_wrong_heights,
          _with_extension),
    Check("changing light", lambda state: state.of_landings, _with_changing_light),
    Check("rises", lambda state: state.of_landings and state.has_evidence, _with_rises),
    Check("fluctuation", lambda state: not state.scale, _with_fluctuation),
)  # fmt: skip
"""In their order: what an earlier one changes, a later one sees."""


def checked(found: DetectionResult) -> Checked:
    """Check the rows of a movie."""
    fits, evidence = found.fits, found.evidence
    achieved: dict[str, EmpiricalSpread] = {}
    if found.repeats:
        achieved = measure_spread(found.context.mode, fits, found.repeats, found.empty)
    state = Checked(
        found, fits, achieved,
        Evidence(*(np.zeros((0, len(Evidence._fields))) if evidence is None else evidence).T),
        np.zeros(len(fits), dtype=bool),
    )  # fmt: skip
    for check in CHECKS:
        state = check.run(state) if check.needs(state) else state
    return state


def measured_scale(found: Mapping[str, EmpiricalSpread]) -> dict[str, float]:
    """Factor of σ with ``fit.sigma = "measured"``: the spread over the bound."""
    return {f"sigma_{name}": max(a.over_crb, 1.0) for name, a in found.items()}
