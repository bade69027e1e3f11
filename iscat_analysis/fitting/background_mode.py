"""Which frames stand against which: three ways, and what says which of them a movie is analysed in.

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

from typing import Literal

from iscat_analysis.config import ALL, Config
from iscat_analysis.errors import ConfigError

BackgroundMode = Literal["fixed", "sliding", "tracks"]


def background_mode(config: Config) -> BackgroundMode:
    """Tell which frames are compared with which."""
    method = config.background.method
    if method == "sliding":
        if config.fit.likelihood == "poisson":
            raise ConfigError(
                'fit.likelihood = "poisson" takes the background for known, but background.method '
                '= "sliding" measures it: use "auto", give the frames before the particles as '
                'background.frames = [0, 200], or a known level with background.method = "known"'
            )
        return "sliding"
    learnt = method == "tracks" or config.background.frames == ALL
    return "tracks" if learnt else "fixed"


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
