"""Work in a copy of this process, which ends when it is done."""

from __future__ import annotations

import os
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from iscat_analysis.copies import LostError, aside
from iscat_analysis.errors import DataError

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="no copies elsewhere")


def _children() -> set[int]:
    """Give the processes of this one that have not been buried."""
    found = set()
    for status in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):  # it has ended
            if int(status.read_text().rsplit(")", 1)[1].split()[1]) == os.getpid():
                found.add(int(status.parent.name))
    return found


def _wait_until_buried(before: set[int]) -> None:
    until = time.monotonic() + 20.0
    while _children() - before:
        assert time.monotonic() < until, "a copy stays"
        time.sleep(0.01)


def test_what_the_work_gives_is_handed_back_and_no_process_stays() -> None:
    before = _children()
    here = np.arange(5)
    found = aside(lambda: (os.getpid(), here + 1)).result(20.0)
    assert found[0] != os.getpid()
    assert found[1].tolist() == [1, 2, 3, 4, 5]
    _wait_until_buried(before)


def test_what_the_work_raises_is_raised() -> None:
    before = _children()

    def fail() -> None:
        raise DataError("movie.tif: is wrong")

    with pytest.raises(DataError, match=r"movie\.tif: is wrong"):
        aside(fail).result(20.0)
    _wait_until_buried(before)


def test_a_copy_that_is_killed_is_told() -> None:
    before = _children()
    with pytest.raises(LostError):
        aside(lambda: os.kill(os.getpid(), 9)).result(20.0)
    _wait_until_buried(before)
