"""Which frames stand against which, and their sums.

==========  ====================================================================  ================
way         frames                                                                method
==========  ====================================================================  ================
"fixed"     those with particles, together or one by one, against a background    fixed, median,
            recorded before them, or against a known level                        known
"sliding"   windows just after each frame against those just before it            sliding
"tracks"    each frame against what all frames have in common without particles   tracks; median,
                                                                                  or fixed (mean),
                                                                                  of all frames
==========  ====================================================================  ================
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera import Camera, Check, check_counts, measure_windows
from iscat_analysis.config import ALL, Config, Way
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.movie import Stack
from iscat_analysis.records import FrameSource, Progress, Windows, silent
from iscat_analysis.search.frames import cut_off
from iscat_analysis.units import count

BackgroundMode = Way


def background_mode(config: Config) -> BackgroundMode:
    """Background mode of a configuration: fixed, sliding or tracks."""
    if config.background.slides and config.fit.likelihood == "poisson":
        raise ConfigError(
            'fit.likelihood = "poisson" takes the background for known, but background.method '
            '= "sliding" measures it: use "auto", give the frames before the particles as '
            'background.frames = [0, 200], or a known level with background.method = "known"'
        )
    return config.background.way


def describe_background_mode(config: Config) -> str:
    """Describe in words which frames are compared with which."""
    background = config.background
    those = "all of them" if background.frames == ALL else "background.frames"
    if background.recorded:
        those = "frames {}:{}".format(*background.recorded)
    others = "frames are compared with"
    words = {
        "fixed": f"{others} the mean of {those}",
        "median": f"{others} the median of {those}",
        "known": f"{others} background.level_e = {background.level_e or 0:g}",
        "sliding": "frames just after each frame are compared with those just before it",
        "tracks": f"{others} the light that all have in common, learnt with the tracks",
    }
    return f'background.method = "{background.method}": {words[str(background.method)]}'


def frame_ranges(movie: Stack, config: Config) -> tuple[tuple[int, int] | None, tuple[int, int]]:
    """Give the ranges of frames that are background, and that are fitted."""
    before = config.background.recorded
    if config.background.learnt_with_tracks:  # in dark field: all frames are both
        before = fitted_frames(movie, config)
        return before, before
    if config.background.is_known:
        before = None
    elif before is None:
        raise ConfigError(
            "which frames come before the particles? give them as "
            'background.frames = [0, 200], or a known level with background.method = "known"'
            f"{_without_frames_before(config)}"
        )
    start = before[1] if before else 0
    after = fitted_frames(movie, config, before)
    if after[1] <= after[0]:
        raise DataError(
            f"{movie.name}: has {count(movie.shape[0], 'frame')} and the background takes "
            f"{start} of them, so none is left to fit; change background.frames"
            f"{_without_frames_before(config)}"
        )
    return before, after


def _without_frames_before(config: Config) -> str:
    """Name the backgrounds that need no frames before the particles."""
    if not config.optics.interferes:
        learnt = '; without such frames background.method = "tracks" learns it with the tracks'
        return learnt if config.fit.follows_tracks else ""
    if config.fit.follows_tracks:
        return (
            '; without such frames background.method = "tracks" learns the background with the '
            'tracks, and background.frames = "all" takes the median of all frames, or with '
            'background.method = "fixed" their mean'
        )
    return '; without such frames background.method = "sliding" takes those before each landing'


def fitted_frames(
    movie: FrameSource, config: Config, before: tuple[int, int] | None = None
) -> tuple[int, int]:
    """Give the frames that are fitted: ``fit.frames``, or all after the background."""
    first, last = config.fit.frames or (before[1] if before else 0, movie.shape[0])
    if last > movie.shape[0]:
        raise DataError(
            f"{movie.name}: has {count(movie.shape[0], 'frame')}, but fit.frames asks for "
            f"{first}:{last}; change fit.frames"
        )
    return first, last


def tracked_frames(movie: Stack, config: Config) -> int:
    """Count the frames in which mode ``track`` looks for particles."""
    first, last = fitted_frames(movie, config, config.background.recorded)
    return max(last - first, 0)


def checked(movie: FrameSource, camera: Camera) -> Check:
    """Make the function that refuses impossible counts of a movie."""
    return partial(check_counts, name=movie.name, camera=camera)


def measured_windows(
    movie: FrameSource,
    config: Config,
    camera: Camera,
    before: tuple[int, int] | None,
    after: tuple[int, int],
    *,
    progress: Progress = silent,
) -> Windows:
    """Sum the background and the frames after it, as configured."""
    background, refuse = config.background, checked(movie, camera)

    def check(counts: NDArray[Any], first: int) -> None:
        whole = ~cut_off(counts, camera)
        if whole.all():
            refuse(counts, first)
            return
        for number in np.flatnonzero(whole).tolist():
            refuse(counts[number : number + 1], first + number)

    checks = check if config.optics.interferes else refuse
    return measure_windows(
        movie, camera, before, after, background, check=checks, progress=progress
    )
