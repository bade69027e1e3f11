"""Joint fit of rows and background: the maximum of the likelihood of `MovingField`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from iscat_analysis.medians import middle
from iscat_analysis.records import BoolArray
from iscat_analysis.tracking.joint.ascent import MOST_STEP_RATIO, ascend
from iscat_analysis.tracking.joint.likelihood import MovingField
from iscat_analysis.tracking.joint.localizations import BackgroundEstimate, Localizations

MOST_TURNS = 12
"""Steps at most."""

_SETTLED = 0.1  # step of the background, in its own standard deviations, that is the last one
_NEXT_STEP_SETTLED = 0.02  # the same, of the next step if it shrinks as the last one did
_ROUGH_STEP = 2.0  # step that is the last one while particles are still being looked for
# Frames in fewer of which particles hardly leave their places: what lies between the background and
# a particle is then a step of many pixels together, which is small in each.
_FEW_FRAMES = 60
_TURNS_FACTOR = 5  # times the turns, of so few frames
# A step below the one after one above the other calls for new rings
_NEAR_STEP, _FAR_STEP = 0.5, 5.0
_MEDIAN_FRAMES = 400  # that suffice: particles are found over it, and fitted over a better one
_DAMPING = 0.01  # of Newton's step, at first
_DAMPING_UP, _DAMPING_DOWN = 10.0, 0.25  # by what it changes where the turns grow, or shrink fast
_POWER_TURNS = 3  # over a background that stays
_POWER_SETTLED = 1e-7


def first_background(field: MovingField, *, follow_power: bool) -> BackgroundEstimate:
    """Median of frames, each over its power; of a long movie, of some that are spread over it."""
    power = np.ones(field.frames)
    if follow_power:
        power = field.frame_totals / field.frame_totals.mean()
    some = slice(None, None, max(field.frames // _MEDIAN_FRAMES, 1))
    scale = (1 / power[some]).astype(np.float32)
    level = np.empty(field.used.shape)

    def median(row: int) -> None:
        each = field.exposures.electrons(some, row) * scale[:, None]
        level[row] = middle(np.ascontiguousarray(each.T))

    field.share(median, len(level))
    return BackgroundEstimate(np.maximum(level, 1e-3), power)


def fit_jointly(
    field: MovingField,
    ground: BackgroundEstimate,
    rows: Localizations,
    *,
    follow_power: bool,
    follow_level: bool = True,
    turns: int = MOST_TURNS,
    coarse: bool = False,
) -> tuple[Localizations, BackgroundEstimate, BoolArray]:
    """Fit rows and background in turn until neither changes."""
    sigma = 1 / np.sqrt(np.maximum(field.total_e, 1.0))
    settled, foreseen, roughly = _SETTLED, _NEXT_STEP_SETTLED, _ROUGH_STEP
    if field.frames < _FEW_FRAMES:
        turns, settled, foreseen, roughly = turns * _TURNS_FACTOR, settled / 10, 0.0, roughly / 10
    largest, length, change, damping = 0.0, np.inf, 0.0, _DAMPING
    done, step = np.ones(len(rows.frame), dtype=bool), np.zeros(field.used.shape)
    for turn in range(turns):
        rows, found, done = field.fit(ground, rows, coarse=coarse)
        power = found.power if follow_power else ground.power
        if not follow_level:
            steady = bool(np.abs(power - ground.power).max() < _POWER_SETTLED)
            ground = replace(ground, power=power)
            if steady or turn + 1 >= _POWER_TURNS:
                break
            continue
        move = np.where(field.used, np.log(found.level / ground.level), 0.0)
        last, length = length, float(np.linalg.norm(move / sigma))
        damping *= _DAMPING_UP if length > last else _DAMPING_DOWN if length < last / 2 else 1.0
        step = field.where_turns_end(move, damping)
        if not coarse and np.linalg.norm(step / sigma) > MOST_STEP_RATIO * length:
            return ascend(field, ground, rows, follow_power=follow_power)
        before, change = change, float(np.abs(step / sigma)[field.used].max(initial=0.0))
        level = np.where(field.used, ground.level * np.exp(step), found.level)
        ground = BackgroundEstimate(level, power)
        largest = max(largest, change)
        if change < _NEAR_STEP and largest > _FAR_STEP and not coarse:
            field.draw_anew()
            largest = change
        elif change < (roughly if coarse else settled) or change**2 < foreseen * before:
            break
    if follow_level:
        rows = field.followed(rows, step)
    return rows, ground, done
