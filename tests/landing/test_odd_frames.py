"""What the user is told of frames that are left out."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from iscat_analysis.landing.find import frame_warnings


@pytest.mark.parametrize(("missing", "lost"), [(3, ""), (400, "67% of the movie")])
def test_frames_left_out_are_told_with_what_is_lost(missing: int, lost: str) -> None:
    """A pixel that is NaN in two thirds of the frames costs two thirds of the landings."""
    merged: Any = SimpleNamespace(
        repeats=lambda: np.arange(200, 200 + missing), masks=lambda: (0, 0),
        trajectory=lambda: None, unfollowed=list,
    )  # fmt: skip
    light = np.full(600, 1e4)
    light[200 : 200 + missing] = np.nan
    (said,) = frame_warnings("m.tif", merged, None, light, 0, 50)
    assert said.startswith("m.tif: frames 200, 201, 202")
    assert ("lost" in said) == bool(lost)
    assert lost in said
