"""Finished chunks of a landing movie on disk."""

from __future__ import annotations

import numpy as np

from iscat_analysis.camera.drift import Trajectory
from iscat_analysis.fitting.checkpoint import Checkpoint, packed_views, unpacked_views
from iscat_analysis.landing.merging import FinishedChunk
from iscat_analysis.landing.searched import Searched
from iscat_analysis.records import FloatArray
from iscat_analysis.search.empty import EmptySpread


class Store(Checkpoint):
    """Finished chunks of a landing movie on disk."""

    def load(self, number: int) -> FinishedChunk | None:
        """Give a finished chunk, or None."""
        found = self.read(number)
        if found is None:
            return None
        lines, data = found
        try:
            low, high = (int(n) for n in data["core"])
            return FinishedChunk(
                core=(low, high),
                lines=lines,
                repeats=data["repeats"],
                evidence=data["evidence"],
                views=unpacked_views(data),
                good=data["good"],
                light=data["light"],
                masked=data["masked"],
                saturated=data["saturated"],
                strongest=data["strongest"],
                ends_e=data["ends_e"],
                trajectory=_trajectory(data["trajectory"]),
                cause=str(data["cause"]),
                untold=data["untold"],
                searched=Searched(data["searched_frames"], data["searched_shares"]),
                empty=_empty(data["squares"], data["number"], data["shared"]),
            )
        except (ValueError, KeyError):
            return None

    def save(self, number: int, done: FinishedChunk) -> None:
        """Keep a finished chunk."""
        searched = done.searched or Searched.joined(())
        arrays = {
            "searched_frames": searched.frames,
            "searched_shares": searched.shares,
            "core": np.array(done.core),
            "repeats": done.repeats,
            "evidence": done.evidence,
            **packed_views(done.views),
            "good": done.good,
            "light": done.light,
            "masked": done.masked,
            "saturated": done.saturated,
            "strongest": done.strongest,
            "ends_e": done.ends_e,
            "trajectory": _columns(done.trajectory),
            "cause": np.array(done.cause),
            "untold": done.untold,
            "squares": np.empty(0) if done.empty is None else done.empty.squares,
            "number": np.empty(0) if done.empty is None else done.empty.counts,
            "shared": np.empty(0) if done.empty is None else done.empty.shared,
        }
        self.write(number, done.lines, arrays)


def _columns(motion: Trajectory | None) -> FloatArray:
    if motion is None:
        return np.empty((0, 5))
    return np.column_stack([motion.frames, motion.shift_px, motion.error_px])


def _empty(squares: FloatArray, counts: FloatArray, shared: FloatArray) -> EmptySpread | None:
    return EmptySpread(squares, counts, shared) if counts.size else None


def _trajectory(columns: FloatArray) -> Trajectory | None:
    return Trajectory(columns[:, 0], columns[:, 1:3], columns[:, 3:]) if len(columns) else None
