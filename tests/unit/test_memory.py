"""Memory that is freed is kept for the next arrays, and only while it shall be."""

import ctypes
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest

from iscat_analysis.memory import freed_memory_kept

resource = pytest.importorskip("resource")

PAGE = resource.getpagesize()
PAGES = 48 * 2**20 // PAGE


def _cleared() -> int:
    """Count the pages that the system clears for an array."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    room = ctypes.create_string_buffer(PAGES * PAGE)
    np.frombuffer(room, dtype=np.uint8)[::PAGE] = 1
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def _cleared_before_within_and_after() -> tuple[list[int], list[int], int]:
    before = [_cleared(), _cleared()]
    with freed_memory_kept():
        within = [_cleared(), _cleared()]
    return before, within, _cleared()


@pytest.mark.skipif(
    sys.platform != "linux" or not hasattr(ctypes.CDLL(None), "mallopt"),
    reason="not GNU's C library",
)
def test_freed_memory_is_kept_and_given_back_at_the_end() -> None:
    """In a process that has freed nothing else."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        before, within, after = pool.submit(_cleared_before_within_and_after).result()
    assert min(*before, within[0], after) > PAGES / 2
    assert within[1] < PAGES / 10
