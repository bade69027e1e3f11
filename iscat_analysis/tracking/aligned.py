"""Pictures of particles that move: frames of a track on top of each other.

A single frame hides what the model leaves over of a particle in its noise; the mean of a track does
not.  What is left over of each frame, moved by whole pixels, is added up for the frames in which
the particle stands on the same part of a pixel, and the model's picture of a particle that stands
still is put back there: a picture as of a particle that does not move, with the light of all these
frames.  That it was blurred is in what is left over already, with the configured optics; another
microscope changes the blur of a picture by much less than the picture.

The frames are put where their own noise says.  Of a frame with the covariance Σ of its place the
model then leaves over −½ ∂²C:Σ on average, C the contrast (what the wrong place blurs, less twice
that, because noise and place go together): C blurred by Σ less C, which is put back.

Where heights are fitted no two frames show the same: each is a picture of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.inference.counts import poisson
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.instrument.particle_image import ParticleImage
from iscat_analysis.optics.forward import PixelGrid
from iscat_analysis.optics.model import blurred
from iscat_analysis.optics.parameters import FAINTEST
from iscat_analysis.records import BoolArray, FloatArray
from iscat_analysis.tracking.joint.common import variances_left
from iscat_analysis.tracking.moving import TrackedRows

PHASES = 3
"""Parts of a pixel along each axis."""

LEAST_FRAMES = 20
"""Of a track that is looked at."""

MOST_TRACKS = 16
"""The brightest are looked at."""

MOST_SINGLE = 36
"""Frames of their own that are looked at: each has a height that is searched."""

MOST_SMEARED_NM = 25.0
"""Spread of the path in a frame of its own that is looked at: of a longer one the picture is no
longer that of a normal distribution about the mean."""

IntArray = NDArray[np.int64]


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
            grid=likelihood.grid, noise=likelihood.noise, data=likelihood.data,
            x_nm=x, y_nm=y, z_nm=z, mass_kda=float(context.model.scale.mass(theta[3])),
            snr=float(np.sqrt(np.sum(signal**2 * likelihood.signal_information(signal)))),
            owner=int(self.track[number]),
            heights_nm=fit.z_range_nm if fit.mode == "joint" else None,
        )  # fmt: skip


def align(context: AnalysisContext, moving: TrackedRows) -> Aligned:
    """Superpose the frames of the brightest tracks."""
    side = _side(context)
    empty = np.zeros((0, side, side))
    nothing = np.zeros(0, dtype=np.int64)
    none = Aligned(nothing, empty, empty, empty, np.zeros((0, 5)), nothing)
    rows, field = moving.rows, moving.field
    if not len(rows.frame):
        return none
    good = moving.converged & ~moving.close & field.holds(rows.theta)
    if field.free[2]:
        good &= (rows.snr > FAINTEST) & (moving.smear_nm < MOST_SMEARED_NM)
    else:
        good &= np.isfinite(moving.common.amplitude)[rows.track]
    chosen = np.flatnonzero(_brightest(rows.track, rows.snr, good))
    if not len(chosen):
        return none
    return _single(context, moving, chosen) if field.free[2] else _summed(context, moving, chosen)


def _side(context: AnalysisContext) -> int:
    """Largest odd side within the fitted square, so that a pixel is in the middle."""
    return (context.roi_px - 1) // 2 * 2 + 1


def _brightest(track: IntArray, snr: FloatArray, good: BoolArray) -> BoolArray:
    """Choose the rows of the tracks with the most information."""
    energy = np.bincount(track, weights=np.where(good, snr**2, 0.0))
    enough = np.bincount(track, weights=good) >= LEAST_FRAMES
    best = np.argsort(-np.where(enough, energy, -1.0), kind="stable")[:MOST_TRACKS]
    return np.asarray(good & np.isin(track, best[enough[best]]))


def _single(context: AnalysisContext, moving: TrackedRows, chosen: IntArray) -> Aligned:
    """Take single frames, from all heights alike."""
    rows = moving.rows
    ranked = chosen[np.argsort(rows.theta[chosen, 2], kind="stable")]
    some = np.linspace(0, len(ranked) - 1, min(MOST_SINGLE, len(ranked))).round().astype(np.int64)
    chosen = np.sort(ranked[some])
    side, theta = _side(context), rows.theta[chosen].copy()
    corner = np.rint(theta[:, 1::-1] / context.pixel_nm).astype(np.int64) - side // 2
    theta[:, :2] -= corner[:, ::-1] * context.pixel_nm
    sums, owner = np.zeros((len(chosen), 3, side, side)), np.arange(len(chosen))
    corner = np.ascontiguousarray(corner)
    moving.field.add_squares(moving.ground, rows, chosen, corner, owner, sums)
    left, light, read = np.moveaxis(sums, 1, 0)
    grid = PixelGrid.region((0, side), (0, side), context.pixel_nm)
    counts = left + light
    for number, (x, y, z, amplitude, _) in enumerate(theta.tolist()):
        counts[number] += light[number] * context.model.amplitude_image(grid, x, y, z, amplitude)
    return Aligned(rows.track[chosen], counts, light, read, theta, np.ones(len(chosen), np.int64))


def _summed(context: AnalysisContext, moving: TrackedRows, chosen: IntArray) -> Aligned:
    """Add up what is left over of rows, by track and part of the pixel."""
    rows, field, ground = moving.rows, moving.field, moving.ground
    side, pixel = _side(context), context.pixel_nm
    places = rows.theta[chosen, :2] / pixel
    whole = np.rint(places).astype(np.int64)
    part = np.floor((places - whole + 0.5) * PHASES).clip(0, PHASES - 1).astype(np.int64)
    key = (rows.track[chosen] * PHASES + part[:, 1]) * PHASES + part[:, 0]
    keys, index = np.unique(key, return_inverse=True)
    variance = variances_left(moving.judged.fisher[chosen], np.flatnonzero(field.free[:4]))
    sums = np.zeros((len(keys), 3, side, side))
    corner = whole[:, ::-1] - side // 2
    field.add_squares(ground, rows, chosen, np.ascontiguousarray(corner), index, sums)
    left, light, read = np.moveaxis(sums, 1, 0)
    count = np.bincount(index)
    middle = [np.bincount(index, weights=v) / count for v in (places - whole).T]
    spread = np.bincount(index, weights=variance[:, :2].mean(axis=1)) / count
    track = keys // PHASES**2
    theta = np.zeros((len(keys), 5))
    theta[:, 0], theta[:, 1] = ((v + side // 2) * pixel for v in middle)
    theta[:, 2], theta[:, 3] = context.model.height_nm, moving.common.amplitude[track]
    grid = PixelGrid.region((0, side), (0, side), pixel)
    counts = left + light
    for number, (x, y, z, amplitude, _) in enumerate(theta.tolist()):
        unsure = blurred(context.model, float(spread[number]), upwards=False)
        counts[number] += light[number] * unsure.amplitude_image(grid, x, y, z, amplitude)
    return Aligned(track, counts, light, read, theta, count.astype(np.int64))
