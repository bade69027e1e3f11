"""Which frames are background and which are fitted."""

from __future__ import annotations

from iscat_analysis.config import Config
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.movie import Stack


def frame_ranges(movie: Stack, config: Config) -> tuple[tuple[int, int] | None, tuple[int, int]]:
    """Which frames are background and which are fitted.

    Parameters
    ----------
    movie : Stack
        The movie.
    config : Config
        ``background.frames``, ``background.method`` and ``fit.frames``.

    Returns
    -------
    before : (int, int) or None
        None where the background is known.
    after : (int, int)
        Half-open.

    Raises
    ------
    ConfigError
        The background frames are not given.
    DataError
        The background leaves no frame to fit.
    """
    before = config.background.frames
    if config.background.method == "known":
        before = None
    elif before is None:
        raise ConfigError(
            "which frames come before the particles? give them as "
            'background.frames = [0, 200], or a known level with background.method = "known"'
        )
    start = before[1] if before else 0
    after = fitted_frames(movie, config, before)
    if after[1] <= after[0]:
        raise DataError(
            f"{movie.name}: has {movie.shape[0]} frames and the background takes "
            f"{start} of them, so none is left to fit; change background.frames"
        )
    return before, after


def fitted_frames(movie: Stack, config: Config, before: tuple[int, int] | None) -> tuple[int, int]:
    """Which frames are looked at: ``fit.frames``, or all after the background.

    Parameters
    ----------
    movie : Stack
        The movie.
    config : Config
        ``fit.frames``.
    before : (int, int) or None
        The background's frames, None where it has none.

    Returns
    -------
    (int, int)
        Half-open; it may be empty.
    """
    return config.fit.frames or (before[1] if before else 0, movie.shape[0])


def tracked_frames(movie: Stack, config: Config) -> int:
    """Count the frames in which mode ``track`` looks for particles.

    Parameters
    ----------
    movie : Stack
        The movie.
    config : Config
        Its ranges may be left open.

    Returns
    -------
    int
        At least 0.
    """
    first, last = fitted_frames(movie, config, config.background.frames)
    return max(min(last, movie.shape[0]) - first, 0)
