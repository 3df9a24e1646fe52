"""Writes LLVM's language: vectors of four numbers, and of eight of the nine of a 3 × 3 block."""

from __future__ import annotations

from functools import reduce
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types

WIDTH = 4
"""Numbers in a vector."""

FLAGS = ("contract", "nsz")
"""What may be done to sums and products: fused, and the sign of zero forgotten."""

READ, KEEP, DATA = 0, 3, 1
"""Arguments of ``llvm.prefetch``: to be read, to stay in all caches, no instructions."""

Value = Any
"""A value, or a pointer, in LLVM's language."""

INDEX, LANE = ir.IntType(64), ir.IntType(32)


class Code:
    """Writes the code of one call with named arguments."""

    def __init__(self, context: Any, builder: Any, signature: Any, arguments: Any, names: str) -> None:
        self._context, self.builder = context, builder
        self.given = dict(zip(names.split(), arguments, strict=True))
        self._types = dict(zip(names.split(), signature.args, strict=True))
        number = context.get_value_type(self._types["blocks"].dtype)
        self.vector, self.eight = ir.VectorType(number, WIDTH), ir.VectorType(number, 8)

    def begin(self, name: str) -> Value:
        """Where an array begins."""
        made = self._context.make_array(self._types[name])
        return made(self._context, self.builder, self.given[name]).data

    def integer(self, name: str) -> Value:
        return self._context.cast(self.builder, self.given[name], self._types[name], types.int64)

    def at(self, begin: Value, row: Value, width: int) -> Value:
        """Where a row of an array begins."""
        return self.builder.gep(begin, [self.builder.mul(row, INDEX(width))])

    def number(self, begin: Value, position: Value) -> Value:
        """An entry of an array of indices."""
        found = self.builder.load(self.builder.gep(begin, [position]))
        return found if found.type == INDEX else self.builder.zext(found, INDEX)

    def load(self, pointer: Value, kind: Any = None) -> Value:
        """A vector, of four if nothing else is said, of what stands in memory from there on."""
        kind = self.vector if kind is None else kind
        found = self.builder.load(self.builder.bitcast(pointer, kind.as_pointer()))
        found.align = self._size
        return found

    def store(self, vector: Value, pointer: Value) -> None:
        self.builder.store(vector, self.builder.bitcast(pointer, vector.type.as_pointer())).align = self._size

    @property
    def _size(self) -> int:
        return 8 if isinstance(self.vector.element, ir.DoubleType) else 4

    def pick(self, one: Value, other: Value, *lanes: int) -> Value:
        """A vector of these numbers of two vectors; those of the other are counted on."""
        kind = ir.VectorType(LANE, len(lanes))
        return self.builder.shuffle_vector(one, other, ir.Constant(kind, list(lanes)))

    def nothing(self, kind: Any = None) -> Value:
        return ir.Constant(self.vector if kind is None else kind, ir.Undefined)

    def vectors(self, name: str) -> list[Value]:
        """Of a tuple of sums: each as a vector. A sum: three numbers, or pairs of a factor and three."""
        return self._sums(self.given[name], self._types[name])

    def pairs(self, name: str) -> list[list[Value]]:
        """Of a tuple of pairs of sums."""
        of_pairs = zip(self._unpacked(self.given[name]), self._types[name], strict=True)
        return [self._sums(pair, kinds) for pair, kinds in of_pairs]

    def _sums(self, given: Value, kinds: Any) -> list[Value]:
        return [self._sum(one, kind) for one, kind in zip(self._unpacked(given), kinds, strict=True)]

    def _sum(self, given: Value, kind: Any) -> Value:
        if not isinstance(kind[0], types.BaseTuple):
            return self.filled(self._unpacked(given))
        pairs = map(self._unpacked, self._unpacked(given))
        parts = [self.times(self.repeat(factor), self.filled(self._unpacked(of))) for factor, of in pairs]
        return reduce(self.plus, parts)

    def _unpacked(self, given: Value) -> list[Value]:
        return cgutils.unpack_tuple(self.builder, given)  # type: ignore[no-untyped-call]

    def filled(self, numbers: list[Value], kind: Any = None) -> Value:
        """A vector, of four if nothing else is said, that begins with these numbers."""
        vector = self.nothing(kind)
        for i, number in enumerate(numbers):
            vector = self.builder.insert_element(vector, number, LANE(i))
        return vector

    def repeat(self, scalar: Value, width: int = WIDTH) -> Value:
        """A vector of one number."""
        first = self.builder.insert_element(self.nothing(), scalar, LANE(0))
        return self.pick(first, self.nothing(), *[0] * width)

    def columns(self, block: Value) -> list[Value]:
        """The three columns of a block; what follows the last is not read."""
        one, two, last = (self.load(self.builder.gep(block, [INDEX(first)])) for first in (0, 3, 5))
        return [one, two, self.pick(last, self.nothing(), 1, 2, 3, 3)]

    def times(self, one: Value, other: Value) -> Value:
        return self.builder.fmul(one, other, flags=FLAGS)

    def plus(self, one: Value, other: Value) -> Value:
        return self.builder.fadd(one, other, flags=FLAGS)

    def numbers(self, name: str) -> list[Value]:
        """Of a tuple."""
        return self._unpacked(self.given[name])

    def tuples(self, name: str) -> list[list[Value]]:
        """Of a tuple of tuples."""
        return [self._unpacked(one) for one in self.numbers(name)]

    def spread(self, vector: Value) -> Value:
        """Of the first eight numbers of left rightᵀ, row by row, the factors that are left's."""
        return self.pick(vector, vector, 0, 0, 0, 1, 1, 1, 2, 2)

    def tiled(self, vector: Value) -> Value:
        """Of the first eight numbers of left rightᵀ, row by row, the factors that are right's."""
        return self.pick(vector, vector, 0, 1, 2, 0, 1, 2, 0, 1)

    def outer(self, left: Value, right: Value) -> tuple[Value, Value]:
        """left rightᵀ: its first eight numbers, row by row, and its last."""
        return self.times(self.spread(left), self.tiled(right)), self.third(self.times(left, right))

    def identity(self, factor: Value) -> Value:
        """The first eight numbers of a factor times the identity."""
        first = self.builder.insert_element(ir.Constant(self.eight, [0.0] * 8), factor, LANE(0))
        return self.builder.insert_element(first, factor, LANE(4))

    def transposed(self, eight: Value) -> Value:
        """Of the first eight numbers of a block, which has the same last one."""
        return self.pick(eight, eight, 0, 3, 6, 1, 4, 7, 2, 5)

    def minus_sum(self, one: Value, other: Value) -> Value:
        return self.builder.fneg(self.plus(one, other))

    def third(self, vector: Value) -> Value:
        return self.builder.extract_element(vector, LANE(2))

    def summed(self, *products: tuple[Value, Value]) -> Value:
        return reduce(self.plus, [self.times(one, other) for one, other in products])

    def swapped(self, offset: Value, one: Value, other: Value) -> tuple[Value, Value]:
        """Two vectors, the other first where the offset says that a block is added transposed."""
        odd = self.is_odd(offset, one.type.count)
        return self.builder.select(odd, other, one), self.builder.select(odd, one, other)

    def add_block(self, block: Value, eight: Value, ninth: Value) -> None:
        """Add to a block in memory its first eight numbers and its last one."""
        self.store(self.plus(self.load(block, self.eight), eight), block)
        last = self.builder.gep(block, [INDEX(8)])
        self.builder.store(self.plus(self.builder.load(last), ninth), last)

    def six_offsets(self) -> list[Value]:
        """Those of the couplings (0, 0), (0, 1), …, (2, 2) of element ``e``, in ``offsets`` (E, 6)."""
        row = self.at(self.begin("offsets"), self.integer("e"), 6)
        return [self.builder.load(self.builder.gep(row, [INDEX(pair)])) for pair in range(6)]

    def is_odd(self, offset: Value, width: int) -> Value:
        """In all lanes, as processors choose between vectors without a jump."""
        odd = self.builder.trunc(offset, ir.IntType(1))
        one = self.builder.insert_element(
            ir.Constant(ir.VectorType(odd.type, width), ir.Undefined), odd, LANE(0)
        )
        return self.pick(one, one, *[0] * width)

    def add_six(self, offsets: list[Value], blocks: list[tuple[Value, Value]]) -> None:
        """Add six blocks of an element as they are, as ``add_block`` takes them, where offsets say."""
        builder, begin = self.builder, self.begin("blocks")

        def add(pair: int) -> None:
            at = builder.ashr(offsets[pair], offsets[pair].type(1))
            at = at if at.type == INDEX else builder.sext(at, INDEX)
            self.add_block(self.at(begin, at, 9), *blocks[pair])

        # a rank that owns the rows of all three points owns all blocks
        own = builder.or_(builder.or_(offsets[0], offsets[3]), offsets[5])
        with builder.if_else(self.is_ours(own), likely=True) as (all_of_them, some):
            with all_of_them:
                for pair in range(6):
                    add(pair)
            with some:
                for pair in range(6):
                    with builder.if_then(self.is_ours(offsets[pair])):
                        add(pair)

    def is_ours(self, offset: Value) -> Value:
        return self.builder.icmp_signed(">=", offset, offset.type(0))

    def fetch(self, pointer: Value) -> None:
        """Let memory come into the caches; it need not be ours."""
        byte = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [byte, LANE, LANE, LANE])
        function = self.builder.module.declare_intrinsic("llvm.prefetch", [byte], kind)
        self.builder.call(function, [self.builder.bitcast(pointer, byte), LANE(READ), LANE(KEEP), LANE(DATA)])

    def loop(self) -> Any:
        """Over the blocks from ``lo`` to ``hi``."""
        return cgutils.for_range_slice(
            self.builder, self.integer("lo"), self.integer("hi"), INDEX(1), intp=INDEX
        )
