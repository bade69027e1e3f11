"""The maximum of the likelihood of `MovingField`, and what the frames of one track have in common.

Of a particle that hardly moves the background takes all but its displacements times its mass, and
how large these are for themselves is told by what is of second order in them.  Newton's step along
that direction is the quotient of two small numbers, of which the lower one, 1 − E, is known no
better than the expected information is the observed one: some steps are twenty times too long, or
lead the other way.  So `ascend` takes a step back where the likelihood falls, and damps the next
(Levenberg 1944, Marquardt 1963).  A turn without Newton's step always climbs.

The information on all parameters of a track over an unknown background is, per pixel,

    J = Σ_t w_t B ∂C_t ∂C_tᵀ/(1 + C_t) − (Σ_t w_t B ∂C_t)(Σ_t w_t B ∂C_t)ᵀ / Σ_t w_t B (1 + C_t).

The second part, of rank one in each pixel, is what the background takes.  Shared among the frames
it takes 1/T from each, but adds up for what they have in common: a particle that hardly moves is
told from its background by its motion alone, and how it moved must be told as well.

With F_t = (R_t R_tᵀ)⁻¹ the information of frame t on its own (x, y, z, a), G_t = w_t B ∂C_t, N the
counts of each pixel and E = N⁻½ Σ_t G_tᵀ F_t⁻¹ G_t N⁻½, a row has the covariance

    F_t⁻¹ + R_t P_t (1 − E)⁻¹ P_tᵀ R_tᵀ,    P_t = R_tᵀ G_t N⁻½.

P_t P_tᵀ is some 1/T, so that the eigenvalues of E add up to no more than a row has parameters: few
of them are large, however many pixels the track covers.  (1 − E)⁻¹ is therefore worked out in the
space that a few images span, which are sent through E until the largest are among them (block
Krylov method: Musco and Musco, Adv. Neural Inf. Process. Syst. 28, 2015), and is 1 beyond.

A mass that is common to the frames has the information Σ_t J_t − cᵀ (1 − E')⁻¹ c, with J_t that of
frame t when its place follows, c the image that it sends then, and E' the E of the places alone; it
is solved by conjugate gradients.  Tracks are taken one by one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from iscat_analysis._kernels.background_response import Slopes, follow, own_shares, send
from iscat_analysis.config import BackgroundConfig
from iscat_analysis.medians import middle
from iscat_analysis.records import BoolArray, FloatArray, IntArray
from iscat_analysis.tracking.field import BLOCK, MovingField
from iscat_analysis.tracking.rows import BackgroundEstimate, Judged, Localizations

MOST_TURNS = 12
"""Steps at most."""

MOST_STEP_RATIO = 5.0
"""Newton's step over the move of one turn, from which it is not trusted."""

_SETTLED = 0.1  # step of the background, in its own standard deviations, that is the last one
_NEXT_STEP_SETTLED = 0.02  # the same, of the next step if it shrinks as the last one did
_ROUGH_STEP = 2.0  # step that is the last one while particles are still being looked for
_NEAR_STEP, _FAR_STEP = 0.5, 5.0  # one below the former after one above the latter: new rings
_DAMPING = 0.01  # of Newton's step, at first and at least: by as much 1 − E is wrong
_DAMPING_UP, _DAMPING_DOWN = 10.0, 0.25  # by what it changes where the turns grow, or shrink fast
_MOST_STEPS = 40


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
        if value < best - 0.5:  # noise of the drawing
            rows, ground = kept
            damping *= _DAMPING_UP
            continue
        best, kept = max(best, value), (rows, found)
        damping = max(0.5 * damping, _DAMPING)
        step, gain = _damped_step(field, move, counts, damping)
        ground = BackgroundEstimate(found.level * np.exp(step - move), found.power)
        if gain < 0.05:  # expected gain of the step that is the last one
            return field.response.followed(rows, step), ground, done
    return *kept, done


def _damped_step(
    field: MovingField, move: FloatArray, counts: FloatArray, damping: float
) -> tuple[FloatArray, float]:
    """Damp a Newton step until the likelihood is expected to rise; give the expected gain."""
    while True:
        step = field.response.step(move, field.total_e, field.used, damping)
        gain = 0.5 * float(np.sum(counts * move * step))
        if not gain <= 0 or not move.any():  # one that is no number climbs no better when damped
            return step, gain
        damping *= _DAMPING_UP


def log_likelihood(field: MovingField, ground: BackgroundEstimate, rows: Localizations) -> float:
    """Profile log-likelihood of rows: the background maximises it under these rows."""
    total, power = field.draw(ground, rows, coarse=False), ground.power

    def block(first: int) -> FloatArray:
        here = slice(first, first + BLOCK)
        # a signal below −0.99 is none of a particle
        signal = np.maximum(total[here].astype(np.float64), -0.99)
        bright = power[here, None, None] * (1 + signal)
        seen = np.einsum("tyx,tyx->yx", field.exposures.electrons(here), np.log1p(signal))
        return np.stack([seen, bright.sum(axis=0)])

    seen, stretch = field.sum_of(block)
    each = seen - field.total_e * np.log(stretch)
    return float(each[field.used].sum() + field.frame_totals @ np.log(power))


def first_background(field: MovingField, background: BackgroundConfig) -> BackgroundEstimate:
    """Median of frames, each over its power, or the mean of all where the background is fixed.

    Of a long movie it is that of some frames that are spread over it.
    """
    power = np.ones(field.frames)
    if background.power_normalization:
        power = field.frame_totals / field.frame_totals.mean()
    if background.method == "fixed":
        return BackgroundEstimate(np.maximum(field.total_e / power.sum(), 1e-3), power)
    # 400 frames suffice: particles are found over their median, and fitted over a better one
    some = slice(None, None, max(field.frames // 400, 1))
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
    background: BackgroundConfig,
    *,
    turns: int = MOST_TURNS,
    coarse: bool = False,
) -> tuple[Localizations, BackgroundEstimate, BoolArray]:
    """Fit rows and background in turn until neither changes."""
    follow_power, follow_level = background.power_normalization, background.learnt_with_tracks
    sigma = 1 / np.sqrt(np.maximum(field.total_e, 1.0))
    least, foreseen = _ROUGH_STEP if coarse else _SETTLED, _NEXT_STEP_SETTLED
    # In few frames particles hardly leave their places: what lies between the background and a
    # particle is then a step of many pixels together, which is small in each.
    if field.frames < 60:
        turns, least, foreseen = 5 * turns, least / 10, 0.0
    largest, length, change, damping = 0.0, np.inf, 0.0, _DAMPING
    done, step = np.ones(len(rows.frame), dtype=bool), np.zeros(field.used.shape)
    for turn in range(turns):
        rows, found, done = field.fit(ground, rows, coarse=coarse)
        power = found.power if follow_power else ground.power
        if not follow_level:
            steady = bool(np.abs(power - ground.power).max() < 1e-7)
            ground = replace(ground, power=power)
            if steady or turn + 1 >= 3:  # over a background that stays
                break
            continue
        move = np.where(field.used, np.log(found.level / ground.level), 0.0)
        last, length = length, float(np.linalg.norm(move / sigma))
        damping *= _DAMPING_UP if length > last else _DAMPING_DOWN if length < last / 2 else 1.0
        step = field.response.step(move, field.total_e, field.used, damping)
        if not coarse and np.linalg.norm(step / sigma) > MOST_STEP_RATIO * length:
            return ascend(field, ground, rows, follow_power=follow_power)
        before, change = change, float(np.abs(step / sigma)[field.used].max(initial=0.0))
        level = np.where(field.used, ground.level * np.exp(step), found.level)
        ground = BackgroundEstimate(level, power)
        largest = max(largest, change)
        if change < _NEAR_STEP and largest > _FAR_STEP and not coarse:
            field.draw_anew()
            largest = change
        elif change < least or change**2 < foreseen * before:
            break
    if follow_level:
        rows = field.response.followed(rows, step)
    return rows, ground, done


class Coupling:
    """Some rows and the pixels of their squares."""

    def __init__(
        self, field: MovingField, ground: BackgroundEstimate, slopes: Slopes, rows: IntArray
    ) -> None:
        self._slopes, self._rows = slopes, rows
        squares = slopes.squares[rows]
        top, left = squares[:, 0].min(), squares[:, 2].min()
        bottom, right = squares[:, 1].max(), squares[:, 3].max()
        self._squares = squares - np.array([top, top, left, left])
        cut = slice(top, bottom), slice(left, right)
        level = ground.level[cut]
        share = np.where(field.used[cut], level / (level + field.read_e2[cut]), 0.0)
        self._weight = share / np.maximum(field.total_e[cut], 1.0)
        self._sigma = np.sqrt(self._weight)

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return self._weight.size

    def own(self) -> FloatArray:
        """Information that each row by itself loses to the background, G N⁻¹ Gᵀ.

        Shapes: result (n, free, free).
        """
        shares: FloatArray = own_shares(self._slopes, self._rows, self._squares, self._weight)
        return shares

    def sent(self, by: FloatArray) -> FloatArray:
        """Change of the background that changes of rows make, N⁻½ Σ Gᵀ by.

        Shapes: `by` (n, b, free), result (b, pixels).
        """
        out = np.zeros((by.shape[1], *self._weight.shape))
        send(self._slopes, self._rows, self._squares, by, out)
        return (out * self._sigma).reshape(len(out), -1)

    def followed(self, covariance: FloatArray, images: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Let rows respond to images; give the responses and the images that these make.

        Shapes: `covariance` (n, free, free), `images` (b, pixels), `felt` (n, b, free), `back` (b,
        pixels).
        """
        seen = np.multiply(images.reshape(-1, *self._weight.shape), self._sigma, order="C")
        felt, out = follow(self._slopes, self._rows, self._squares, covariance, seen)
        return felt, (out * self._sigma).reshape(images.shape)


_SINGULAR = 1e-9
MOST_VARIANCE_LEFT_OUT = 3e-4  # of the variance of a row, that may be left out
_MOST_AMPLITUDE_RATIO = 2.0  # amplitude over the mean, beyond which weights stay
MOST_STEPS = 400


@dataclass(frozen=True)
class CommonAmplitudes:
    """Amplitudes that are common to the frames of each track."""

    amplitude: FloatArray
    variance: FloatArray
    known: FloatArray
    frames: FloatArray


def shared_errors(
    field: MovingField, ground: BackgroundEstimate, rows: Localizations, judged: Judged
) -> FloatArray:
    """Say what the background adds to the errors of the rows.

    Shapes: result (n, 4, 4).
    """
    index = np.flatnonzero(field.free[:4])
    covariance = np.zeros((len(rows.frame), 4, 4))

    tracks = [mine for mine in _tracks(rows, judged, index) if mine.size]

    def of_one(k: int) -> None:
        coupling = Coupling(field, ground, judged.slopes, tracks[k])
        added = _added(coupling, _inverse(judged.fisher[tracks[k]], index))
        covariance[np.ix_(tracks[k], index, index)] = added

    field.share(of_one, len(tracks))
    return covariance


def _added(coupling: Coupling, inverse: FloatArray) -> FloatArray:
    """Covariance of every row besides its own, shape (n, free, free)."""
    free = inverse.shape[1]
    root = np.asarray(np.linalg.cholesky(inverse), dtype=np.float64)
    turned = np.swapaxes(root, 1, 2)
    inner = turned @ coupling.own() @ root
    most = float(np.linalg.eigvalsh(inner)[:, -1].max())
    # as no eigenvalue is larger than their sum
    if _variance_left_out(most, float(np.einsum("nii->", inner))) > MOST_VARIANCE_LEFT_OUT:
        more = _krylov_part(coupling, root, most)
        if more is None:
            return np.broadcast_to(np.diag(np.full(free, np.inf)), inverse.shape)
        inner += more
    return np.asarray(root @ inner @ turned)


def _variance_left_out(most: float, largest: float) -> float:
    """Tell how much of the variance of a row is left out with eigenvalues of E, at most."""
    return most * largest / (1 - largest) if largest < 1 else np.inf


def _krylov_part(coupling: Coupling, root: FloatArray, most: float) -> FloatArray | None:
    """P (1 − E)⁻¹ Pᵀ − P Pᵀ of every row, but for what is small; None where 1 − E is singular."""
    n, free = root.shape[:2]
    covariance = root @ np.swapaxes(root, 1, 2)
    rank = min(n * free, coupling.pixels)
    # four images are sent through E at a time
    some = np.random.default_rng(1).standard_normal((n, min(4, rank), free))
    images = coupling.sent(some @ np.swapaxes(root, 1, 2))
    basis, felt = np.empty((0, coupling.pixels)), np.empty((n, 0, free))
    largest = 1.0
    while len(basis) < rank and _variance_left_out(most, largest) > MOST_VARIANCE_LEFT_OUT:
        added = _orthonormal(images, basis)[: rank - len(basis)]
        seen, images = coupling.followed(covariance, added)
        seen = seen @ root
        basis, felt = np.concatenate([basis, added]), np.concatenate([felt, seen], axis=1)
        # those of the next images, and of what is left out, are smaller
        largest = float(np.linalg.eigvalsh(_products(seen))[-1])
    values, turns = np.linalg.eigh(_products(felt))
    if values[-1] > 1 - _SINGULAR:
        return None
    along = np.swapaxes(felt, 1, 2) @ turns
    return np.asarray((along * (values / (1 - values))) @ np.swapaxes(along, 1, 2))


def _products(felt: FloatArray) -> FloatArray:
    """E between images that rows feel, shape (n, b, free)."""
    return np.tensordot(felt, felt, axes=((0, 2), (0, 2)))


def _orthonormal(images: FloatArray, basis: FloatArray) -> FloatArray:
    """Make images orthonormal, to a basis as well."""
    for _ in range(2):  # what rounding leaves of the basis goes the second time
        images = images - (images @ basis.T) @ basis
        images = np.linalg.qr(images.T)[0].T
    return images


def variances_left(information: FloatArray, index: IntArray) -> FloatArray:
    """Give the variances that matrices of information leave.

    Shapes: `information` (n, 4, 4), result (n, 4).
    """
    out = np.full(information.shape[:2], np.nan)
    scaled, scale = _scaled(information, index)
    good = np.flatnonzero(np.isfinite(scaled).all(axis=(1, 2)))
    if not good.size:
        return out
    good = good[np.linalg.eigvalsh(scaled[good])[:, 0] > _SINGULAR]
    inverse = np.einsum("nii->ni", np.linalg.inv(scaled[good])) * scale[good] ** 2
    out[good[:, None], index] = inverse
    return out


def _scaled(fisher: FloatArray, index: IntArray) -> tuple[FloatArray, FloatArray]:
    """Informations of some parameters with ones on the diagonal, and what made them so."""
    part = fisher[:, index][:, :, index]
    scale = 1 / np.sqrt(np.maximum(np.einsum("nii->ni", part), 1e-300))
    return part * scale[:, :, None] * scale[:, None, :], scale


def _inverse(fisher: FloatArray, index: IntArray) -> FloatArray:
    """Invert informations on some parameters, shape (n, len(index), len(index))."""
    scaled, scale = _scaled(fisher, index)
    return np.linalg.inv(scaled) * scale[:, :, None] * scale[:, None, :]


def _tracks(rows: Localizations, judged: Judged, index: IntArray) -> list[IntArray]:
    """Give the rows of each track whose own information is no singular matrix."""
    known = np.linalg.det(_scaled(judged.fisher, index)[0]) > _SINGULAR
    order = np.argsort(rows.track, kind="stable")
    edges = np.searchsorted(rows.track[order], np.arange(1, int(rows.track.max(initial=-1)) + 1))
    return [mine[known[mine]] for mine in np.split(order, edges)] if order.size else []


def common_amplitudes(
    field: MovingField,
    ground: BackgroundEstimate,
    rows: Localizations,
    judged: Judged,
    counted: BoolArray,
) -> CommonAmplitudes:
    """Fit one amplitude to all frames of each track, with the background that is most likely then.

    Shapes: `counted` (n,).
    """
    index = np.flatnonzero(field.free[:4])
    tracks = _tracks(rows, judged, index)
    out = np.full((4, len(tracks)), np.nan)

    def of_one(k: int) -> None:
        mine = tracks[k]
        used = counted[mine]
        if not used.any():
            return
        fisher = judged.fisher[mine]
        along, information = _marginal(fisher, index[:-1])
        estimate = rows.theta[mine, 3] - judged.bias[mine, 3]
        information = used * information
        mean, more = _at_their_mean(rows.theta[mine, 3], estimate, information, judged.growth[mine])
        weight = information * more
        sends = np.column_stack([-along, np.ones(mine.size)]) * (used * np.sqrt(more))[:, None]
        covariance = _inverse(fisher, index)
        covariance[used] = 0.0
        covariance[used, :-1, :-1] = _inverse(fisher[used], index[:-1])
        coupling = Coupling(field, ground, judged.slopes, mine)
        off = estimate - mean
        mode, sent_offset = coupling.sent(np.stack([sends, sends * off[:, None]], axis=1))
        total = weight.sum()
        answer, taken = _spread_over(coupling, covariance, mode)
        left = total - taken
        out[2:, k] = 1 / total, total**2 / np.sum(weight**2)
        if left > _SINGULAR * total:
            out[:2, k] = mean + (weight @ off - answer @ sent_offset) / left, 1 / left

    field.share(of_one, len(tracks))
    return CommonAmplitudes(*out)


def _at_their_mean(
    amplitude: FloatArray, estimate: FloatArray, information: FloatArray, growth: FloatArray
) -> tuple[float, FloatArray]:
    """Give the mean of amplitudes, and by what the information on each is more at that."""
    power = np.average(growth, weights=information)
    mean, more = float(np.average(estimate, weights=information)), np.ones(len(estimate))
    for _ in range(3):  # of the mean and its weights
        more = np.clip(amplitude / mean, 1 / _MOST_AMPLITUDE_RATIO, _MOST_AMPLITUDE_RATIO) ** -power
        mean = float(np.average(estimate, weights=information * more))
    return mean, more


def _spread_over(
    coupling: Coupling, covariance: FloatArray, image: FloatArray
) -> tuple[FloatArray, float]:
    """Solve (1 − E') answer = image by conjugate gradients; give image · answer as well.

    That is infinite where 1 − E' is singular: no eigenvalue of E' is negative.
    """

    def left(image: FloatArray) -> FloatArray:
        followed: FloatArray = coupling.followed(covariance, image[None])[1][0]
        return image - followed

    square = (image.size, image.size)
    operator = scipy.sparse.linalg.LinearOperator(square, left, dtype=np.float64)
    answer, _ = scipy.sparse.linalg.cg(operator, image, rtol=1e-7, maxiter=MOST_STEPS)
    taken = float(image @ answer)
    return answer, taken if taken >= image @ image else np.inf


def _marginal(fisher: FloatArray, others: IntArray) -> tuple[FloatArray, FloatArray]:
    """How places follow an amplitude, shape (n, others), and the information on that then."""
    along = np.einsum("nij,nj->ni", _inverse(fisher, others), fisher[:, others, 3])
    return along, fisher[:, 3, 3] - np.einsum("ni,ni->n", along, fisher[:, others, 3])
