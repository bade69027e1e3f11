"""Frames of which tests write files, and how they look at what was read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from iscat_analysis.errors import DataError
from iscat_analysis.movie import open_stack

SHAPE = (7, 6, 5)
COUNTS = np.random.default_rng(1).integers(0, 60000, SHAPE).astype(np.uint16)


def assert_whole(address: Path | str, expected: np.ndarray = COUNTS) -> None:
    with open_stack(address) as stack:
        assert stack.shape == expected.shape
        assert stack.dtype == expected.dtype.newbyteorder("=")
        block = stack.read(0, len(expected))
        assert np.array_equal(block, expected)
        assert block.dtype.isnative
        assert (block if block.base is None else block.base).flags.owndata
        assert block.flags.writeable
        assert np.array_equal(stack.read(2, 5), expected[2:5])
        assert stack.read(3, 3).shape == (0, *expected.shape[1:])


def refused(address: Path | str, *parts: str) -> None:
    with pytest.raises(DataError) as raised:
        open_stack(address)
    for part in parts:
        assert part in str(raised.value)
    assert "\n" not in str(raised.value)
