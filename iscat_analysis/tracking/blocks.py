"""What is kept of finished blocks of frames, pictures of their tracks, and all of them together.

Blocks share no frames and no background, so that their rows are independent, and so are the masses
of their parts of a track: each is that of the exact likelihood of its block, with its variance.
The D of each part, which sets its blur, is told from that part alone, and its error is in the
variance of the mass.

Of a single frame the noise hides what the model leaves over of a particle; of the mean of a track
it does not.  What is left over of each frame, moved by whole pixels, is added up for the frames in
which the particle stands on the same part of a pixel, and the model's picture of a particle that
stands still is put back there: a picture as of a particle that does not move, with the light of all
these frames.  The blur is in what is left over already, with the configured optics; another
microscope changes the blur of a picture by much less than the picture.

The frames are put where their own noise says.  Of a frame with the covariance Σ of its place the
model then leaves over −½ ∂²C:Σ on average, C the contrast (what the wrong place blurs, less twice
that, because noise and place go together): C blurred by Σ less C, which is put back.

Where heights are fitted no two frames show the same: each is a picture of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pandas as pd

from iscat_analysis._kernels.canvas import box_of
from iscat_analysis.config import Config
from iscat_analysis.diagnosis import Noise, judge_beside, smear_warning
from iscat_analysis.findings import Finding, FindingKind
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.fitting.results import Followed
from iscat_analysis.fitting.run import Checkpoint
from iscat_analysis.inference.counts import poisson
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.instrument.particle_image import ParticleImage
from iscat_analysis.optics.forward import PixelGrid
from iscat_analysis.optics.model import blurred
from iscat_analysis.optics.parameters import FAINTEST
from iscat_analysis.records import BoolArray, EventView, FloatArray, IntArray, Windows
from iscat_analysis.threads import start_in_thread
from iscat_analysis.tracking.field import MovingField
from iscat_analysis.tracking.frames import Recording
from iscat_analysis.tracking.joint import variances_left
from iscat_analysis.tracking.linking import (
    OUTLYING,
    bridge,
    link,
    numbered,
    track_ends,
    typical_error,
    with_mass,
)
from iscat_analysis.tracking.rows import BackgroundEstimate, Localizations
from iscat_analysis.tracking.stages import TrackedRows, find_rows_and_background
from iscat_analysis.tracking.table import common_masses, moving_table, table_of_tracks

PHASES = 3
"""Parts of a pixel along each axis."""

LEAST_FRAMES = 20
"""Of a track that is looked at."""

MOST_TRACKS = 16
"""The brightest are looked at."""


@dataclass(frozen=True)
class Aligned:
    """Pictures of tracks."""

    track: IntArray
    counts_e: FloatArray
    light_e: FloatArray
    read_e2: FloatArray
    theta: FloatArray
    frames: IntArray

    def likelihood(self, context: AnalysisContext, number: int) -> Likelihood:
        """Give the likelihood of a picture of a particle that stands still."""
        light = self.light_e[number]
        side = light.shape[0]
        return poisson(
            context.model,
            PixelGrid.region((0, side), (0, side), context.pixel_nm),
            self.counts_e[number],
            light,
            light,
            extra_variance_e2=self.read_e2[number],
            masked=light <= 0,
        )

    def particle_image(self, context: AnalysisContext, number: int) -> ParticleImage:
        """Give one picture in the form that the measurement of the microscope takes."""
        likelihood = self.likelihood(context, number)
        theta = self.theta[number]
        fit = context.config.fit
        x, y, z = (float(v) for v in theta[:3])
        signal = likelihood.signal(theta)
        return ParticleImage(
            grid=likelihood.grid,
            noise=likelihood.noise,
            data=likelihood.data,
            x_nm=x,
            y_nm=y,
            z_nm=z,
            mass_kda=float(context.model.scale.mass(theta[3])),
            snr=float(np.sqrt(np.sum(signal**2 * likelihood.signal_information(signal)))),
            owner=int(self.track[number]),
            heights_nm=fit.z_range_nm if fit.heights_free else None,
        )


def align(context: AnalysisContext, moving: TrackedRows) -> Aligned:
    """Superpose the frames of the brightest tracks, or take single ones where heights are free."""
    rows, field, pixel = moving.rows, moving.field, context.pixel_nm
    side = (context.roi_px - 1) // 2 * 2 + 1  # so that a pixel is in the middle
    heights_free = bool(field.free[2])
    good = moving.done & ~moving.close & field.holds(rows.theta)
    if heights_free:
        # of a path longer than 25 nm the picture is no longer that of a normal distribution
        good &= (rows.snr > FAINTEST) & (moving.smear_nm < 25.0)
    else:
        good &= np.isfinite(moving.common.amplitude)[rows.track]
    chosen = np.flatnonzero(_brightest(rows.track, rows.snr, good))
    if not len(chosen):
        return NO_PICTURES
    if heights_free:  # 36 from all heights alike: each has a height that is searched
        ranked = chosen[np.argsort(rows.theta[chosen, 2], kind="stable")]
        some = np.linspace(0, len(ranked) - 1, min(36, len(ranked))).round().astype(int)
        chosen = np.sort(ranked[some])
    places, track = rows.theta[chosen, :2] / pixel, rows.track[chosen]
    whole = np.rint(places).astype(np.int64)
    owner = np.arange(len(chosen))
    if not heights_free:  # by track and part of the pixel
        part = np.floor((places - whole + 0.5) * PHASES).clip(0, PHASES - 1).astype(np.int64)
        key = (track * PHASES + part[:, 1]) * PHASES + part[:, 0]
        owner = np.unique(key, return_inverse=True)[1]
    count = np.bincount(owner)

    def mean(values: FloatArray) -> FloatArray:
        return np.bincount(owner, weights=values) / count

    track = track[np.unique(owner, return_index=True)[1]]
    theta = np.zeros((len(count), 5))
    theta[:, :2] = np.transpose([mean(v) + side // 2 for v in (places - whole).T]) * pixel
    if heights_free:
        spread, theta[:, 2:4] = np.zeros(len(count)), rows.theta[chosen, 2:4]
    else:
        variance = variances_left(moving.judged.fisher[chosen], np.flatnonzero(field.free[:4]))
        spread = mean(variance[:, :2].mean(axis=1))
        theta[:, 2], theta[:, 3] = context.model.height_nm, moving.common.amplitude[track]
    corner, grid = whole[:, ::-1] - side // 2, PixelGrid.region((0, side), (0, side), pixel)
    left, light, read = field.superposed(moving.ground, rows, chosen, corner, owner, side)
    counts = left + light
    for number, (x, y, z, amplitude, _) in enumerate(theta.tolist()):
        unsure = blurred(context.model, float(spread[number]), upwards=False)
        counts[number] += light[number] * unsure.amplitude_image(grid, x, y, z, amplitude)
    return Aligned(track, counts, light, read, theta, count.astype(np.int64))


def _brightest(track: IntArray, snr: FloatArray, good: BoolArray) -> BoolArray:
    """Choose the rows of the tracks with the most information."""
    energy = np.bincount(track, weights=np.where(good, snr**2, 0.0))
    enough = np.bincount(track, weights=good) >= LEAST_FRAMES
    best = np.argsort(-np.where(enough, energy, -1.0), kind="stable")[:MOST_TRACKS]
    return np.asarray(good & np.isin(track, best[enough[best]]))


_NOTHING, _EMPTY = np.zeros(0, dtype=np.int64), np.zeros((0, 1, 1))
NO_PICTURES = Aligned(_NOTHING, _EMPTY, _EMPTY, _EMPTY, np.zeros((0, 5)), _NOTHING)


@dataclass(frozen=True)
class Block:
    """The results of a block of frames."""

    span: tuple[int, int]
    rows: Localizations
    error: float
    table: pd.DataFrame
    inside: BoolArray
    masses: pd.DataFrame
    views: tuple[EventView, ...]
    windows: Windows
    """The background and the sum of all frames, side by side."""

    noise: tuple[Finding, ...] = ()
    noise_differs: bool = False
    aligned: Aligned = NO_PICTURES

    @property
    def level_e(self) -> float:
        """Mean light of a pixel of a frame [e]."""
        windows = self.windows
        return float(windows.before_e[~windows.masked].mean()) / windows.n_before


def analyse_block(
    context: AnalysisContext,
    recording: Recording,
    span: tuple[int, int],
    *,
    goes_on: tuple[bool, bool],
    cautious: bool = False,
) -> Block:
    """Analyse the particles of a block of frames."""
    first, frames = span[0], span[1] - span[0]
    # Nearer to a border than this a track may go on in the next block.
    near = context.config.track.memory_frames + 1
    inner = (near if goes_on[0] else 0, frames - near if goes_on[1] else frames)
    moving = find_rows_and_background(context, recording, span, inner=inner, cautious=cautious)
    field, ground, rows = moving.field, moving.ground, moving.rows

    def without(count: int) -> FloatArray:
        pictures.result()  # of which all frames are drawn
        light: FloatArray = ground.level * ground.power[:count, None, None]
        return light + field.residual(ground, rows, 0, count)

    if not goes_on[0]:
        seen = rows.frame + first, rows.theta[:, :2]
        pictures = start_in_thread(align, context, moving)
        source = recording.movie, recording.camera
        judged = start_in_thread(judge_beside, context, *source, span, seen, field.used, without)
    table, inside = moving_table(context, moving, first), field.holds(rows.theta)
    masses = common_masses(context, moving)
    best = table.loc[table[inside].groupby("track")["snr"].idxmax()]
    aligned, noise = NO_PICTURES, Noise()
    if not goes_on[0]:
        aligned = pictures.result()
        noise = judged.result().compared_with_fits(table["chi2_reduced"].to_numpy(float))
        smeared = smear_warning(context.config, table, moving.smear_nm)
        if smeared:  # what is left over of pictures, far around them, is not the camera's
            noise = Noise((smeared,))
    read = frames * recording.camera.read_variance_e2((field.used.shape[0], field.used.shape[1]))
    return Block(
        span=span,
        rows=replace(rows, frame=rows.frame + first),
        error=typical_error(moving.judged.fisher) if len(rows.frame) else 0.0,
        table=table,
        inside=inside,
        masses=masses,
        views=tuple(row_view(field, ground, rows, int(row)) for row in best.index),
        windows=Windows(
            before_e=ground.level * ground.power.sum(),
            after_e=field.total_e,
            n_before=frames,
            n_after=frames,
            power_ratio=1.0,
            read_variance_before_e2=read,
            read_variance_after_e2=read,
            masked=~field.used,
            saturated=field.saturated,
            frames_before=span,
            frames_after=span,
            power=np.tile(ground.power, 2),
        ),
        noise=noise.findings,
        noise_differs=noise.differs,
        aligned=aligned,
    )


def row_view(
    field: MovingField, ground: BackgroundEstimate, rows: Localizations, mine: int
) -> EventView:
    """Draw a particle in one frame."""
    frame, theta = int(rows.frame[mine]), rows.theta[mine]
    spans = [
        box_of(float(centre), field.pixel_nm, field.roi_px, size)
        for centre, size in zip((theta[1], theta[0]), field.used.shape, strict=True)
    ]
    cut = slice(*spans[0]), slice(*spans[1])
    others = rows.only((rows.frame == frame) & (np.arange(len(rows.frame)) != mine))
    left, alone = (field.residual(ground, r, frame, frame + 1)[0][cut] for r in (rows, others))
    light = ground.power[frame] * ground.level[cut]
    used = field.used[cut]
    noise = np.sqrt(light + (alone - left) + field.read_e2[cut])
    blank = np.where(used, 1.0, np.nan)
    return EventView(
        event=int(rows.track[mine]),
        row_px=spans[0][0],
        column_px=spans[1][0],
        contrast=blank * alone / light,
        model=(alone - left) / light,
        residual=blank * left / noise,
    )


_KEPT = Block, Localizations, Aligned, Windows, Finding, FindingKind


class BlockStore(Checkpoint):
    """Results of blocks on disk."""

    records = (*Checkpoint.records, *_KEPT)


_MASS = ["mass_kda", "sigma_mass_kda", "crb_mass_kda", "told"]


@dataclass(frozen=True)
class Joined:
    """The tracks and backgrounds of all blocks of a movie."""

    fits: pd.DataFrame
    views: tuple[EventView, ...]
    followed: Followed


def join_blocks(config: Config, blocks: Sequence[Block]) -> Joined:
    """Make one result of the blocks of a movie."""
    numbers = join_tracks(config, blocks)
    table = table_of_tracks(
        pd.concat([b.table for b in blocks], ignore_index=True),
        np.concatenate([n[b.rows.track] for n, b in zip(numbers, blocks, strict=True)]),
        np.concatenate([b.inside for b in blocks]),
        config.track.min_frames,
        parted=len(blocks) > 1,
    )
    masses = combine_masses([b.masses for b in blocks], numbers, table)
    parts = tuple(block.windows for block in blocks)
    if len(parts) > 1:
        followed = Followed(_together(blocks), parts, masses)
    else:
        followed = Followed(parts[0], (), masses)
    return Joined(table, _views(table, blocks, numbers), followed)


def join_tracks(config: Config, blocks: Sequence[Block]) -> list[IntArray]:
    """Say which tracks of blocks are one particle.

    At a border the last rows of the tracks that end there and the first of those that begin are
    linked as two frames are, each with the median mass of its track.  A particle may be missed
    there for as many frames as elsewhere, and one that hardly moves for more.

    Shapes: result (tracks of the block,).
    """
    sizes = [int(b.rows.track.max(initial=-1)) + 1 for b in blocks]
    if len(blocks) == 1:
        return [np.arange(sizes[0])]
    numbers = [np.arange(n) + sum(sizes[:k]) for k, n in enumerate(sizes)]
    for k, (one, two) in enumerate(pairwise(blocks)):
        for before, after in _met(config, one, two):
            numbers[k + 1][after] = numbers[k][before]
    rows = [replace(b.rows, track=n[b.rows.track]) for n, b in zip(numbers, blocks, strict=True)]
    whole = Localizations.together(rows).in_order()
    if not len(whole.frame):
        return numbers
    bridged = replace(whole, track=bridge(config, whole))
    last = numbered(replace(bridged, group=whole.track))  # group: the number that it had
    final = np.zeros(int(whole.track.max()) + 1, dtype=np.int64)
    final[last.group] = last.track
    return [final[n] for n in numbers]


def _met(config: Config, one: Block, two: Block) -> list[tuple[int, int]]:
    """Find pairs of tracks of two blocks, where the second continues the first."""
    border, memory = two.span[0], config.track.memory_frames
    ends, begins = track_ends(one.rows, -1), track_ends(two.rows, 0)
    ends = ends.only(ends.frame >= border - 1 - memory)
    begins = begins.only(begins.frame <= border + memory)
    if not len(ends.frame) or not len(begins.frame):
        return []
    both, early = Localizations.together([ends, begins]), len(ends.frame)
    side = (np.arange(len(both.frame)) >= early).astype(np.int64)
    places = with_mass(config, both, np.hypot(one.error, two.error) / np.sqrt(2))
    track = link(side, places, reach_nm=config.track.max_step_nm, memory=0)
    old, new = np.nonzero(track[:early, None] == track[early:])
    short = begins.frame[new] - ends.frame[old] - 1 <= memory
    return list(zip(ends.track[old[short]], begins.track[new[short]], strict=True))


def combine_masses(
    masses: Sequence[pd.DataFrame], numbers: Sequence[IntArray], table: pd.DataFrame
) -> pd.DataFrame:
    """Combine the masses of the parts of tracks by their variances."""
    if len(masses) == 1:
        return masses[0][_MASS]
    parts = pd.concat(masses, ignore_index=True)
    parts["track"] = np.concatenate([n[m.index] for n, m in zip(numbers, masses, strict=True)])
    middle = parts["track"].map(table.groupby("track")["mass_kda"].median())
    near = (parts["mass_kda"] - middle).abs() <= OUTLYING * parts["sigma_mass_kda"]
    merit = (parts["blur"] + 2 * near).where(parts["mass_kda"].notna(), -1.0)
    used = parts[(merit >= 0) & (merit >= merit.groupby(parts["track"]).transform("max"))]
    weight = 1 / used["sigma_mass_kda"] ** 2
    total = weight.groupby(used["track"]).sum()
    out = pd.DataFrame(index=pd.Index(np.unique(parts["track"]), name="track"))
    for name in ("mass_kda", "told"):
        out[name] = (weight * used[name]).groupby(used["track"]).sum() / total
    out["sigma_mass_kda"] = out["crb_mass_kda"] = 1 / np.sqrt(total)
    return out


def _views(
    table: pd.DataFrame, blocks: Sequence[Block], numbers: Sequence[IntArray]
) -> tuple[EventView, ...]:
    """Choose the clearest view of each track."""
    if not len(table):
        return ()
    best = table.loc[table.groupby("track")["snr"].idxmax()]
    block = np.searchsorted([b.span[1] for b in blocks], best["frame"], side="right")
    views: dict[tuple[int, int], EventView] = {}
    for k, (own, of_block) in enumerate(zip(numbers, blocks, strict=True)):
        for view in reversed(of_block.views):
            views[k, int(own[view.event])] = view
    keys = zip(block.tolist(), best["track"].tolist(), strict=True)
    return tuple(replace(views[key], event=key[1]) for key in keys if key in views)


def _together(blocks: Sequence[Block]) -> Windows:
    """Sum the backgrounds and the frames of all blocks."""
    parts = [block.windows for block in blocks]
    frames, span = sum(p.n_before for p in parts), (blocks[0].span[0], blocks[-1].span[1])
    light = np.concatenate([b.windows.power[: b.windows.n_before] * b.level_e for b in blocks])
    read = frames / parts[0].n_before * parts[0].read_variance_before_e2
    return Windows(
        before_e=np.sum([p.before_e for p in parts], axis=0),
        after_e=np.sum([p.after_e for p in parts], axis=0),
        n_before=frames,
        n_after=frames,
        power_ratio=1.0,
        read_variance_before_e2=read,
        read_variance_after_e2=read,
        masked=np.logical_or.reduce([p.masked for p in parts]),
        saturated=np.logical_or.reduce([p.saturated for p in parts]),
        frames_before=span,
        frames_after=span,
        power=np.tile(light / light.mean(), 2),
    )
