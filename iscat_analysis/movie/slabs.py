"""Frames that a file stores several together, in chunks or shards: none is decoded twice.

Whoever reads a few frames decodes all that are stored with them; the next ones are then at hand.
Several threads may read: one decodes a slab, the others wait for it.
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import numpy as np
from numpy.typing import NDArray

_KEPT_BYTES = 2**28  # of decoded frames that are kept
_FEWEST = 2  # slabs: one thread ends in one while another begins in the next


class Slabs:
    """Reads frames through slabs of `depth` frames, of which some are kept."""

    def __init__(
        self,
        read: Callable[[int, int], NDArray[Any]],
        shape: tuple[int, ...],
        dtype: np.dtype[Any],
        depth: int,
    ) -> None:
        self._read, self._shape, self._dtype = read, shape, dtype
        self._depth = min(depth, shape[0])
        slab_bytes = self._depth * math.prod(shape[1:]) * dtype.itemsize
        kept = _KEPT_BYTES // max(slab_bytes, 1) if self._depth > 1 else 0
        self._most = kept if kept >= _FEWEST else 0
        self._kept: OrderedDict[int, Future[NDArray[Any]]] = OrderedDict()
        self._lock = threading.Lock()

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames ``[start, stop)`` as a new array."""
        if not self._most:
            return self._read(start, stop)
        out = np.empty((stop - start, *self._shape[1:]), dtype=self._dtype)
        for number in range(start // self._depth, -(-stop // self._depth)):
            begin = number * self._depth
            end = min(begin + self._depth, self._shape[0])
            low, high = max(begin, start), min(end, stop)
            slab = self._slab(number, begin, end)
            out[low - start : high - start] = slab[low - begin : high - begin]
        return out

    def _slab(self, number: int, begin: int, end: int) -> NDArray[Any]:
        with self._lock:
            found = self._kept.get(number)
            mine = found is None
            if found is None:
                found = self._kept[number] = Future()
            self._kept.move_to_end(number)
            while len(self._kept) > self._most:
                self._kept.popitem(last=False)
        if mine:
            try:
                found.set_result(self._read(begin, end))
            except BaseException as error:
                with self._lock:
                    self._kept.pop(number, None)
                found.set_exception(error)
                raise
        return found.result()
