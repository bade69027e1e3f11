"""A cache for results that take long to compute and are needed again."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import lru_cache
from threading import Lock
from typing import TypeVar, TypeVarTuple

Key = TypeVarTuple("Key")
T = TypeVar("T")


def memoize(size: int, make: Callable[[*Key], T]) -> Callable[[*Key], T]:
    """Keep the last few results of a function.

    If several threads need the same result at the same time, one computes it and the others wait;
    with `functools.lru_cache` each would compute it.
    """

    @lru_cache(size)
    def place(*_: Hashable) -> tuple[Lock, list[T]]:
        return Lock(), []

    def get(*key: *Key) -> T:
        lock, found = place(*key)
        with lock:
            if not found:
                found.append(make(*key))
        return found[0]

    return get
