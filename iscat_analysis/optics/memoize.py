"""Results that take long to make and are asked for again."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import lru_cache
from threading import Lock
from typing import TypeVar, TypeVarTuple

Key = TypeVarTuple("Key")
T = TypeVar("T")


def memoize(size: int, make: Callable[[*Key], T]) -> Callable[[*Key], T]:
    """Keep the last few results of a function.

    Threads that ask for the same at the same time wait for the one that makes it; with
    `functools.lru_cache` each would make its own.
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
