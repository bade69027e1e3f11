"""Arrays that were used last, as many as have room: what is used again soon is not made again.

`memoize` keeps results of a function that take long to compute, `kept` those of a method.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from functools import lru_cache, wraps
from threading import Lock
from typing import Any, Generic, TypeVar, TypeVarTuple

V = TypeVar("V")


class LastUsed(Generic[V]):
    """Values by their keys, within so many bytes; the last one is held whatever it takes."""

    def __init__(self, room_bytes: int) -> None:
        self._room_bytes = room_bytes
        self._held: OrderedDict[Hashable, tuple[V, int]] = OrderedDict()
        self._bytes = 0
        self._lock = Lock()

    def get(self, key: Hashable) -> V | None:
        """Give what is held; None if it is gone or never was there."""
        with self._lock:
            if key not in self._held:
                return None
            self._held.move_to_end(key)
            return self._held[key][0]

    def hold(self, key: Hashable, value: V, size_bytes: int) -> None:
        """Hold a value, and let those go that nobody asked for longest."""
        with self._lock:
            self._bytes += size_bytes - self._held.pop(key, (value, 0))[1]
            self._held[key] = value, size_bytes
            while self._bytes > self._room_bytes and len(self._held) > 1:
                self._bytes -= self._held.popitem(last=False)[1][1]


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


def kept(size: int) -> Callable[[Callable[[Any, *Key], T]], Callable[[Any, *Key], T]]:
    """Let each object keep the last few results of a method."""

    def decorated(method: Callable[[Any, *Key], T]) -> Callable[[Any, *Key], T]:
        name = f"_kept_{method.__name__}"

        @wraps(method)
        def get(self: Any, *key: *Key) -> T:
            def own(*key: *Key) -> T:
                return method(self, *key)

            held: dict[str, Callable[[*Key], T]] = vars(self)
            if name not in held:
                held.setdefault(name, memoize(size, own))
            return held[name](*key)

        return get

    return decorated
