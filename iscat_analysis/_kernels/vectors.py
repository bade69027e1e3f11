"""Vector registers of eight numbers, for loops in which Numba uses none.

They are written as instructions of LLVM, which uses a register for eight numbers or several smaller
ones, as the processor has them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 8
"""Numbers in a register."""

_DOUBLE, _BYTE = ir.DoubleType(), ir.IntType(8)
_INDEX, _LANE = ir.IntType(64), ir.IntType(32)
_FLAGS = ("contract", "nsz")


class Code:
    """Write the instructions of a function of two arrays and the first of eight indices."""

    def __init__(self, context: Any, builder: Any, signature: Any, arguments: Any) -> None:
        self._b = builder
        self.one, self.other = (
            context.make_array(kind)(context, builder, value)
            for kind, value in zip(signature.args[:2], arguments[:2], strict=True)
        )
        self.first = arguments[2]
        numbers = cgutils.unpack_tuple(builder, arguments[3]) if len(arguments) > 3 else []
        self.factors = [self.everywhere(number) for number in numbers]

    def index(self, number: int) -> Any:
        """Write a whole number."""
        return ir.Constant(_INDEX, number)

    def length(self, array: Any, axis: int) -> Any:
        """Give the length of an axis."""
        return cgutils.unpack_tuple(self._b, array.shape)[axis]

    def times(self, one: Any, other: Any) -> Any:
        """Multiply whole numbers."""
        return self._b.mul(one, other)

    def plus(self, one: Any, other: Any) -> Any:
        """Add whole numbers."""
        return self._b.add(one, other)

    def in_row(self, array: Any, row: int, place: Any) -> Any:
        """Point to a place in a row of an array of two axes."""
        stride = cgutils.unpack_tuple(self._b, array.strides)[0]
        data = self._b.bitcast(array.data, _BYTE.as_pointer())
        line = self._b.gep(data, [self._b.mul(stride, self.index(row))])
        return self._b.gep(self._b.bitcast(line, _DOUBLE.as_pointer()), [place])

    def at(self, array: Any, place: Any) -> Any:
        """Point to a place in the memory of an array."""
        return self._b.gep(array.data, [place])

    def load(self, pointer: Any, count: int = LANES) -> Any:
        """Read a register of numbers that follow one another."""
        kind = ir.VectorType(_DOUBLE, count)
        return self._b.load(self._b.bitcast(pointer, kind.as_pointer()), align=8)

    def store(self, register: Any, pointer: Any) -> None:
        """Write a register to memory."""
        self._b.store(register, self._b.bitcast(pointer, register.type.as_pointer()), align=8)

    def parted(self, pointer: Any) -> tuple[list[Any], Any]:
        """Read eight numbers: their integer parts, and a register of their fractional parts."""
        number = self.load(pointer)
        whole = self._b.fptosi(number, ir.VectorType(_INDEX, LANES))
        rest = self._b.fsub(number, self._b.sitofp(whole, number.type), flags=_FLAGS)
        lanes = (ir.Constant(_LANE, k) for k in range(LANES))
        return [self._b.extract_element(whole, lane) for lane in lanes], rest

    def everywhere(self, number: Any) -> Any:
        """Put a number in all lanes of a register."""
        nothing = ir.Constant(ir.VectorType(_DOUBLE, LANES), ir.Undefined)
        one = self._b.insert_element(nothing, number, ir.Constant(_LANE, 0))
        return self.chosen(one, [0] * LANES)

    def chosen(self, x: Any, lanes: list[int]) -> Any:
        """Give the numbers of some lanes."""
        return self._b.shuffle_vector(x, x, _lanes(lanes))

    def multiply(self, x: Any, y: Any) -> Any:
        """Give x y."""
        return self._b.fmul(x, y, flags=_FLAGS)

    def negative(self, x: Any) -> Any:
        """Give −x."""
        return self._b.fneg(x)

    def multiply_add(self, x: Any, y: Any, z: Any) -> Any:
        """Give x y + z."""
        return self._b.fadd(self.multiply(x, y), z, flags=_FLAGS)

    def plus_itself(self, x: Any) -> Any:
        """Give 2 x."""
        return self._b.fadd(x, x, flags=_FLAGS)

    def joined(self, one: Any, other: Any) -> Any:
        """Put two halves of a register together."""
        return self._b.shuffle_vector(one, other, _lanes(range(LANES)))

    def halves(self, x: Any) -> tuple[Any, Any]:
        """Take a register apart."""
        middle = LANES // 2
        return self.chosen(x, [*range(middle)]), self.chosen(x, [*range(middle, LANES)])

    def exchanged(self, rows: list[Any]) -> list[Any]:
        """Transpose eight registers; of four, each half as a square of its own."""
        rows = list(rows)
        width = 1
        while width < len(rows):
            for i in range(len(rows)):
                if i & width:
                    continue
                low = [LANES + (k ^ width) if k & width else k for k in range(LANES)]
                high = [LANES + k if k & width else k | width for k in range(LANES)]
                pair = rows[i], rows[i + width]
                rows[i] = self._b.shuffle_vector(*pair, _lanes(low))
                rows[i + width] = self._b.shuffle_vector(*pair, _lanes(high))
            width *= 2
        return rows


def _lanes(numbers: Any) -> Any:
    chosen = list(numbers)
    return ir.Constant(ir.VectorType(_LANE, len(chosen)), chosen)


def instructions(write: Callable[[Code], None], *, factors: bool = False) -> Callable[..., None]:
    """Make a function for kernels from a function that writes its instructions.

    It takes two arrays, an index, and with `factors` a tuple of numbers.
    """

    def written(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        write(Code(context, builder, signature, arguments))
        return context.get_dummy_value()

    def typed(_: Any, one: Any, other: Any, first: Any) -> tuple[Any, Callable[..., Any]]:
        return types.void(one, other, first), written

    def with_factors(
        _: Any, one: Any, other: Any, first: Any, numbers: Any
    ) -> tuple[Any, Callable[..., Any]]:
        return types.void(one, other, first, numbers), written

    made: Callable[..., None] = intrinsic(with_factors if factors else typed)
    return made
