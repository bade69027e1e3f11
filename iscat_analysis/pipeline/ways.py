"""Which frames stand against which: three ways, and what says which of them a movie is analysed in.

==========  ====================================================================  ================
way         frames                                                                method
==========  ====================================================================  ================
"fixed"     those with particles, together or one by one, against a background    fixed, median,
            recorded before them, or against a known level                        known
"sliding"   windows just after each frame against those just before it            sliding
"tracks"    each frame against what all frames have in common without particles   tracks; median
                                                                                  of all frames
==========  ====================================================================  ================
"""

from __future__ import annotations

from typing import Literal

from iscat_analysis.config import Config
from iscat_analysis.errors import ConfigError

Way = Literal["fixed", "sliding", "tracks"]


def way_of(config: Config) -> Way:
    """Tell in which way a movie is analysed.

    Parameters
    ----------
    config : Config
        Its ``background.method`` decides; a median is that of ``background.frames``, or in mode
        ``track`` of all frames where these are not given.

    Returns
    -------
    {"fixed", "sliding", "tracks"}
        The way.

    Raises
    ------
    ConfigError
        The windows slide, which measures the background, but the likelihood takes it for known.
    """
    method = config.background.method
    if method == "sliding":
        if config.fit.likelihood == "poisson":
            raise ConfigError(
                'fit.likelihood = "poisson" takes the background for known, but background.method '
                '= "sliding" measures it: use "auto", give the frames before the particles as '
                'background.frames = [0, 200], or a known level with background.method = "known"'
            )
        return "sliding"
    median_of_all = (
        method == "median" and config.fit.mode == "track" and config.background.frames is None
    )
    return "tracks" if method == "tracks" or median_of_all else "fixed"
