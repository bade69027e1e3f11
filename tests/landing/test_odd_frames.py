"""What the user is told of frames that are left out."""

from __future__ import annotations

import numpy as np
import pytest

from iscat_analysis.landing.find import frame_findings


@pytest.mark.parametrize(("missing", "lost"), [(3, ""), (400, "67% of the movie")])
def test_frames_left_out_are_told_with_what_is_lost(missing: int, lost: str) -> None:
    """A pixel that is NaN in two thirds of the frames costs two thirds of the landings."""
    light = np.full(600, 1e4)
    light[200 : 200 + missing] = np.nan
    (found,) = frame_findings("m.tif", np.arange(200, 200 + missing), light, 0)
    said = found.text
    assert said.startswith("m.tif: frames 200, 201, 202")
    assert ("lost" in said) == bool(lost)
    assert lost in said
