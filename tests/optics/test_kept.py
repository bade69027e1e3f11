"""Results at hand, for threads that want the same."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier, Event

import pytest

from iscat_analysis.last_used import memoize


def test_threads_that_want_the_same_wait_for_one() -> None:
    made, begun, together = [], Event(), Barrier(4)

    def make(key: int) -> list[int]:
        made.append(key)
        begun.wait(0.2)  # long enough for the others to ask
        return [key]

    get = memoize(2, make)

    def ask(_: int) -> list[int]:
        together.wait(10)
        return get(7)

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(ask, range(4)))
    assert made == [7]
    assert all(each is found[0] for each in found)


def test_the_last_few_are_kept() -> None:
    made: list[int] = []
    get = memoize(2, made.append)
    for key in (1, 2, 1, 3, 1, 2):
        get(key)
    assert made == [1, 2, 3, 2]


def test_a_failure_is_tried_again() -> None:
    tries: list[int] = []

    def make(key: int) -> int:
        tries.append(key)
        if len(tries) == 1:
            raise ValueError("not yet")
        return key

    get = memoize(2, make)
    with pytest.raises(ValueError, match="not yet"):
        get(5)
    assert get(5) == 5
