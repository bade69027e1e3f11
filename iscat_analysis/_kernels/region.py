"""A region of many frames, copied together.

Its rows are short and lie far apart, so that a loop waits for memory at each of them.  Here they
are asked for two frames before they are copied, which takes half of the time.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel

Bytes = NDArray[np.uint8]

_AHEAD = 2  # frames
_READ, _SOON, _DATA = 0, 2, 1  # what LLVM is told of memory that it shall fetch


@intrinsic
def _fetch(_: Any, stored: Any, at: Any) -> Any:
    """Ask for the memory of one byte, and wait for nothing."""

    def written(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        number = ir.IntType(32)
        address = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [address, number, number, number])
        fetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        told = [ir.Constant(number, value) for value in (_READ, _SOON, _DATA)]
        builder.call(fetch, [builder.gep(array.data, [arguments[1]]), *told])
        return context.get_dummy_value()

    return types.void(stored, at), written


@intrinsic
def _copy(_: Any, stored: Any, at: Any, out: Any, to: Any, count: Any) -> Any:
    """Copy bytes from a place in one array to a place in another."""

    def written(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        source, target = (
            builder.gep(context.make_array(kind)(context, builder, array).data, [place])
            for kind, array, place in zip(
                signature.args[0:4:2], arguments[0:4:2], arguments[1:4:2], strict=True
            )
        )
        cgutils.raw_memcpy(builder, target, source, arguments[4], 1)
        return context.get_dummy_value()

    return types.void(stored, at, out, to, count), written


@kernel(_nrt=False)
def copy_region(
    stored: Bytes, start: int, steps: tuple[int, int], shape: tuple[int, int, int], out: Bytes
) -> None:
    """Copy a region of frames.

    Shapes: `stored` (n,), `out` (frames·rows·bytes,).
    """
    frames, rows, width = shape
    to = 0
    for t in range(frames):
        for i in range(rows):
            at = start + t * steps[0] + i * steps[1]
            if t + _AHEAD < frames:
                later = at + _AHEAD * steps[0]
                _fetch(stored, later)
                _fetch(stored, later + width - 1)
            _copy(stored, at, out, to, width)
            to += width
