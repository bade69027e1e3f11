"""Rows and background of particles that hardly move, by steps that the likelihood allows.

Of a particle that hardly moves the background takes all but its displacements times its mass, and
how large these are for themselves is told by what is of second order in them.  Newton's step along
that direction is the quotient of two small numbers, of which the lower one, 1 − E, is known no
better than the expected information is the observed one: some steps are twenty times too long, or
lead the other way.  So a step is taken back where the likelihood falls, and the next is damped
(Levenberg 1944, Marquardt 1963).  A turn without Newton's step always climbs.
"""

from __future__ import annotations

import numpy as np

from iscat_analysis.records import BoolArray, FloatArray
from iscat_analysis.tracking.joint.likelihood import BLOCK, MovingField
from iscat_analysis.tracking.joint.localizations import BackgroundEstimate, Localizations

MOST_STEP_RATIO = 5.0
"""Newton's step over the move of one turn, from which it is not trusted."""

_DAMPING = 0.01  # at first and at least: by as much 1 − E is wrong
_DAMPING_UP, _DAMPING_DOWN = 10.0, 0.5
_LIKELIHOOD_NOISE = 0.5  # of the log-likelihood, by how the canvas is drawn
_LEAST_GAIN = 0.05  # expected gain of the step that is the last one
_MOST_STEPS = 40
_MOST_SIGNAL = 0.99  # signal of a pixel that is taken to be none of a particle's


def ascend(
    field: MovingField, ground: BackgroundEstimate, rows: Localizations, *, follow_power: bool
) -> tuple[Localizations, BackgroundEstimate, BoolArray]:
    """Maximise the likelihood of rows and background by steps that never lower it."""
    counts = np.where(field.used, np.maximum(field.total_e, 1.0), 0.0)
    damping, best, kept = _DAMPING, -np.inf, (rows, ground)
    for _ in range(_MOST_STEPS):
        rows, found, done = field.fit(ground, rows)
        found = BackgroundEstimate(found.level, found.power if follow_power else ground.power)
        move = np.where(field.used, np.log(found.level / ground.level), 0.0)
        value = log_likelihood(field, found, rows)
        if value < best - _LIKELIHOOD_NOISE:
            rows, ground = kept
            damping *= _DAMPING_UP
            continue
        best, kept = max(best, value), (rows, found)
        damping = max(_DAMPING_DOWN * damping, _DAMPING)
        step, gain = _damped_step(field, move, counts, damping)
        ground = BackgroundEstimate(found.level * np.exp(step - move), found.power)
        if gain < _LEAST_GAIN:
            return field.followed(rows, step), ground, done
    return *kept, done


def _damped_step(
    field: MovingField, move: FloatArray, counts: FloatArray, damping: float
) -> tuple[FloatArray, float]:
    """Damp a Newton step until the likelihood is expected to rise; give the expected gain."""
    while True:
        step = field.where_turns_end(move, damping)
        gain = 0.5 * float(np.sum(counts * move * step))
        if not gain <= 0 or not move.any():  # one that is no number climbs no better when damped
            return step, gain
        damping *= _DAMPING_UP


def log_likelihood(field: MovingField, ground: BackgroundEstimate, rows: Localizations) -> float:
    """Profile log-likelihood of rows: the background maximises it under these rows."""
    total, power = field.draw(ground, rows, coarse=False), ground.power

    def block(first: int) -> FloatArray:
        here = slice(first, first + BLOCK)
        signal = np.maximum(total[here].astype(np.float64), -_MOST_SIGNAL)
        bright = power[here, None, None] * (1 + signal)
        seen = np.einsum("tyx,tyx->yx", field.exposures.electrons(here), np.log1p(signal))
        return np.stack([seen, bright.sum(axis=0)])

    seen, stretch = field.sum_of(block)
    each = seen - field.total_e * np.log(stretch)
    return float(each[field.used].sum() + field.frame_totals @ np.log(power))
