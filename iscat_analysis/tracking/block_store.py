"""What is kept of a finished block of frames, in memory and on disk."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis._kernels.canvas import box_of
from iscat_analysis.camera import Camera
from iscat_analysis.diagnosis import Noise, judge_beside, smear_warning
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.fitting.run import Checkpoint
from iscat_analysis.records import BoolArray, CountSource, EventView, FloatArray, Progress, Windows
from iscat_analysis.threads import start_in_thread
from iscat_analysis.tracking.aligned import Aligned, align
from iscat_analysis.tracking.joint.likelihood import MovingField
from iscat_analysis.tracking.joint.localizations import BackgroundEstimate, Localizations
from iscat_analysis.tracking.linking import typical_error
from iscat_analysis.tracking.moving import find_rows_and_background
from iscat_analysis.tracking.moving_table import common_masses, moving_table


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
    level: FloatArray
    power: FloatArray
    total_e: FloatArray
    used: BoolArray
    saturated: BoolArray
    noise: tuple[str, ...] = ()
    noise_differs: bool = False
    aligned: Aligned | None = None

    @property
    def frames(self) -> int:
        """Frames in the block."""
        return self.span[1] - self.span[0]

    def windows(self, camera: Camera) -> Windows:
        """Put the background and the sum of all frames side by side."""
        read = self.frames * camera.read_variance_e2((self.used.shape[0], self.used.shape[1]))
        return Windows(
            before_e=self.level * self.power.sum(),
            after_e=self.total_e,
            n_before=self.frames,
            n_after=self.frames,
            power_ratio=1.0,
            read_variance_before_e2=read,
            read_variance_after_e2=read,
            masked=~self.used,
            saturated=self.saturated,
            frames_before=self.span,
            frames_after=self.span,
            power=np.concatenate([self.power, self.power]),
        )


def analyse_block(
    context: AnalysisContext,
    movie: CountSource,
    camera: Camera,
    span: tuple[int, int],
    *,
    goes_on: tuple[bool, bool],
    check: Callable[[NDArray[Any], int], None],
    pool: ThreadPoolExecutor,
    progress: Progress,
    cautious: bool = False,
) -> Block:
    """Analyse the particles of a block of frames."""
    first, frames = span[0], span[1] - span[0]
    # Nearer to a border than this a track may go on in the next block.
    near = context.config.track.memory_frames + 1
    inner = (near if goes_on[0] else 0, frames - near if goes_on[1] else frames)
    moving = find_rows_and_background(
        context, movie, camera, span,
        check=check, pool=pool, progress=progress, inner=inner, cautious=cautious,
    )  # fmt: skip
    field, ground, rows = moving.field, moving.ground, moving.rows

    def without(count: int) -> FloatArray:
        pictures.result()  # of which all frames are drawn
        light: FloatArray = ground.level * ground.power[:count, None, None]
        return light + field.residual(ground, rows, 0, count)

    if not goes_on[0]:
        seen = rows.frame + first, rows.theta[:, :2]
        pictures = start_in_thread(align, context, moving)
        judged = start_in_thread(
            judge_beside, context, movie, camera, span, seen, field.used, without
        )
    table, inside = moving_table(context, moving, first), field.holds(rows.theta)
    masses = common_masses(context, moving)
    best = table.loc[table[inside].groupby("track")["snr"].idxmax()]
    aligned, noise = None, Noise()
    if not goes_on[0]:
        aligned = pictures.result()
        noise = judged.result().compared_with_fits(table["chi2_reduced"].to_numpy(float))
        smeared = smear_warning(context.config, table, moving.smear_nm)
        if smeared:  # what is left over of pictures, far around them, is not the camera's
            noise = Noise((smeared,))
    return Block(
        span=span,
        rows=replace(rows, frame=rows.frame + first),
        error=typical_error(moving.judged.fisher) if len(rows.frame) else 0.0,
        table=table,
        inside=inside,
        masses=masses,
        views=tuple(row_view(field, ground, rows, int(row)) for row in best.index),
        level=ground.level,
        power=ground.power,
        total_e=field.total_e,
        used=field.used,
        saturated=field.saturated,
        noise=tuple(finding.text for finding in noise.findings),
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


class BlockStore(Checkpoint):
    """Results of blocks on disk."""

    records = (*Checkpoint.records, Block, Localizations, Aligned)
