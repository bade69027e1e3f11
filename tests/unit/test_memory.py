"""Memory that is freed is kept for the next arrays, and only while it shall be."""

import ctypes
import sys
from pathlib import Path

import numpy as np
import pytest

from iscat_analysis.memory import freed_memory_kept

resource = pytest.importorskip("resource")

BYTES = 48 * 2**20
PAGE = resource.getpagesize()


def _pages_cleared() -> int:
    """Fill an array in small pieces, and count the pages that the system had to find for it."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    room = ctypes.create_string_buffer(BYTES)
    np.frombuffer(room, dtype=np.uint8)[::PAGE] = 1
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def _resident() -> int:
    return int(Path("/proc/self/statm").read_text("ascii").split()[1]) * PAGE


@pytest.mark.skipif(
    sys.platform != "linux" or not hasattr(ctypes.CDLL(None), "mallopt"),
    reason="not GNU's C library",
)
def test_freed_memory_is_kept_and_given_back_at_the_end() -> None:
    assert _pages_cleared() > BYTES / PAGE / 2
    with freed_memory_kept():
        _pages_cleared()
        held = _resident()
        assert _pages_cleared() < BYTES / PAGE / 10
    assert _resident() < held - BYTES / 2
    assert _pages_cleared() > BYTES / PAGE / 2
