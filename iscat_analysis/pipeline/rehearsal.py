"""The kernels of an analysis, run on next to nothing, and those first that it needs last.

While an analysis compiles its kernels from the first one on, another process compiles them from the
other end.  Each finds what the other has made, where Numba keeps compiled kernels, and waits for
what the other is at (`iscat_analysis._kernels.claims`).  That process is a copy of the first one,
or on other systems than Linux ``python -m iscat_analysis.pipeline.rehearsal NEED…``.
"""

from __future__ import annotations

import gc
import sys
from collections.abc import Collection
from dataclasses import replace

import numpy as np

from iscat_analysis._kernels.canvas import Light
from iscat_analysis._kernels.following import Slopes
from iscat_analysis._kernels.sliding import strongest_maps
from iscat_analysis._kernels.stepping import add_image
from iscat_analysis.camera.background import find_defects
from iscat_analysis.camera.counts import Camera
from iscat_analysis.config import Config
from iscat_analysis.inference.noise import compile_kernels
from iscat_analysis.inference.repeats import repeats_of, series_of
from iscat_analysis.landing.sidelobes import Sieve
from iscat_analysis.optics.forward import ForwardModel, PixelGrid, forward_model
from iscat_analysis.search.sliding import (
    STRIDES,
    find_steps,
    make_chunk,
    make_filter,
    measure_frames,
    sliding_maps,
)
from iscat_analysis.species.motion import confinement_test
from iscat_analysis.threads import threads
from iscat_analysis.tracking.frame_search import link
from iscat_analysis.tracking.joint.exposures import Exposures
from iscat_analysis.tracking.joint.likelihood import MovingField
from iscat_analysis.tracking.joint.localizations import Ground, Rows
from iscat_analysis.tracking.joint.newton import Response
from iscat_analysis.tracking.joint.track_coupling import Coupling

_REACH_NM = 2000.0
_SIDE, _SQUARE, _FRAMES = 8, 4, 4
_PIXEL_NM = 50.0


def rehearse(needs: Collection[str]) -> None:
    """Run what an analysis runs, from its end."""
    model = forward_model(Config(), _REACH_NM)
    if "tracks" in needs:
        _track(model, free_z="heights" in needs)
        return
    compile_kernels(model, needs, backwards=True)
    if "sliding" in needs:
        _slide()


def _slide() -> None:
    """Run what is done with the windows of a landing movie once the optics are known.

    The first process is at its fits by then.
    """
    camera, side = Camera(), _SIDE
    counts = np.random.default_rng(1).poisson(100.0, (2 * side, side, side)).astype(np.uint16)
    light, repeats = measure_frames(counts, camera)
    chunk = make_chunk(0, counts, ~repeats, light, camera, stride=2, defects=find_defects)
    patch = chunk.patch(0, len(counts), (0, side), (0, side))
    patch.windows([0, side, 2 * side])
    series = series_of(
        patch.counts, np.ones((1, side, side)), patch.power,
        gain=1.0, offset=0.0, mean_e=patch.mean_e, read_variance_e2=np.zeros((side, side)),
    )  # fmt: skip
    repeats_of((series, series))
    matched = make_filter(chunk, np.ones((3, 3)))
    snr, effective = sliding_maps(chunk, matched, STRIDES)
    add_image(snr[0], (0, 0), matched.response((0, 0), np.ones((3, 3)))[1], np.float32(1.0))
    peaks = find_steps(chunk, matched, snr, effective, 0.0)
    Sieve(0, 2, 2 * STRIDES, _SQUARE).sift(peaks, [], snr)
    strongest_maps(snr, np.empty((side, side), dtype=np.int64))


def _track(model: ForwardModel, *, free_z: bool) -> None:
    """Run what is done with tracks, with slopes of rows, with judged rows, and with frames.

    The first process begins with pictures, and draws and fits frames before it needs any other
    kernel here, so that what is judged, which is drawn as well, comes late.
    """
    walk = np.cumsum(np.random.default_rng(1).normal(0, 100, (12, 2)), axis=0)
    confinement_test(np.arange(12), walk, 1.0, frame_rate_hz=100, resamples=1)
    shape = (_FRAMES, _SIDE, _SIDE)
    counts = np.full(shape, 100, dtype=np.uint16)
    theta = np.zeros((_FRAMES, 2, 5))
    theta[:, :, :2] = _PIXEL_NM * _SIDE / 2
    theta[:, :, 2] = model.height_nm
    theta[:, :, 3] = 0.1
    frame, track = np.divmod(np.arange(2 * _FRAMES), 2)
    rows = Rows.of(frame, track, theta.reshape(-1, 5))
    ground = Ground(np.full(shape[1:], 100.0), np.ones(_FRAMES))
    used = np.ones(shape[1:], dtype=np.bool_)
    model.gradient(PixelGrid.centred(3, _PIXEL_NM), 0.0, 0.0, model.height_nm, 1.0)
    with threads(1) as pool:
        slopes = _slopes(len(frame), 4 if free_z else 3)
        light = Light(counts, 1.0, 0.0, ground.power, ground.level, np.ones(shape[1:]))
        response = Response(
            slopes, rows.starts(_FRAMES), light, np.zeros(shape, dtype=np.float32),
            np.tile(np.eye(slopes.values.shape[1]), (len(frame), 1, 1)), pool, joint=True,
        )  # fmt: skip
        response.step(np.full(shape[1:], 1e-3), _FRAMES * ground.level, used, 0.0)
        field = MovingField(
            Exposures(counts), np.ones(shape[1:]), used, model, model, pixel_nm=_PIXEL_NM,
            roi_px=_SQUARE, z_range_nm=(0.0, 100.0) if free_z else None, largest=1.0, pool=pool,
        )  # fmt: skip
        coupling = Coupling(field, ground, slopes, np.arange(2))
        own = coupling.own()
        coupling.followed(own, coupling.sent(np.zeros((2, 1, own.shape[1]))))
        field.judge(ground, rows)
        field.residual(ground, rows, 0, 1)
        link(frame, rows.theta[:, :2], reach_nm=1.0, memory=1)
        corner, sums = np.zeros((2, 2), dtype=np.int64), np.zeros((1, 3, _SQUARE, _SQUARE))
        field.add_squares(ground, rows, np.arange(2), corner, np.zeros(2, dtype=np.int64), sums)
        field.fit(ground, rows)
        field.fit(replace(ground, level=2.0 * ground.level), rows)  # by more than plain steps


def _slopes(rows: int, free: int) -> Slopes:
    """Make slopes of rows that see nothing in their squares."""
    squares = np.tile(np.array([0, _SQUARE, 0, _SQUARE]), (rows, 1))
    values = np.zeros((rows, free, _SQUARE**2), dtype=np.int16)
    return Slopes(squares, values, np.ones((rows, free)), np.zeros((rows, free)))


if __name__ == "__main__":
    gc.disable()  # the process is short, and what it makes stays
    rehearse(sys.argv[1:])
