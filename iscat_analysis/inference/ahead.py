"""Half of the kernels of a fit, compiled in a process of its own while another compiles the rest.

Run as ``python -m iscat_analysis.inference.ahead PART…``, with those of
`iscat_analysis.inference.noise.PARTS` that will be needed.  What it compiles lands where Numba
keeps compiled kernels, and the other process finds it there.
"""

from __future__ import annotations

import gc
import sys
from collections.abc import Collection

from iscat_analysis.config import Config
from iscat_analysis.inference.noise import compile_values
from iscat_analysis.optics.forward import forward_model

_REACH_NM = 2000.0


def main(parts: Collection[str]) -> None:
    """Compile what evaluates likelihoods, their curvature and the goodness of fits.

    Parameters
    ----------
    parts : collection of str
        As in `iscat_analysis.inference.noise.compile_values`.
    """
    compile_values(forward_model(Config(), _REACH_NM), parts)


if __name__ == "__main__":
    gc.disable()  # the process is short, and what it makes stays
    main(sys.argv[1:])
