"""Writes LLVM's language: vectors of four numbers, and blocks of 3 × 3 made of them."""

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
        self.vector = ir.VectorType(context.get_value_type(self._types["blocks"].dtype), WIDTH)

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

    def load(self, pointer: Value) -> Value:
        """A vector of what stands in memory from there on."""
        found = self.builder.load(self.builder.bitcast(pointer, self.vector.as_pointer()))
        found.align = self._size
        return found

    def store(self, vector: Value, pointer: Value) -> None:
        self.builder.store(vector, self.builder.bitcast(pointer, self.vector.as_pointer())).align = self._size

    @property
    def _size(self) -> int:
        return 8 if isinstance(self.vector.element, ir.DoubleType) else 4

    def pick(self, one: Value, other: Value, *lanes: int) -> Value:
        """A vector of these numbers of two vectors; those of the other are counted on."""
        return self.builder.shuffle_vector(one, other, ir.Constant(ir.VectorType(LANE, WIDTH), list(lanes)))

    def nothing(self) -> Value:
        return ir.Constant(self.vector, ir.Undefined)

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
        return cgutils.unpack_tuple(self.builder, given)  # type: ignore[no-any-return, no-untyped-call]

    def filled(self, numbers: list[Value]) -> Value:
        """A vector that begins with these numbers."""
        vector = self.nothing()
        for i, number in enumerate(numbers):
            vector = self.builder.insert_element(vector, number, LANE(i))
        return vector

    def repeat(self, scalar: Value) -> Value:
        """A vector of one number."""
        first = self.builder.insert_element(self.nothing(), scalar, LANE(0))
        return self.pick(first, self.nothing(), 0, 0, 0, 0)

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

    def combined(self, factors: list[Value], two: list[Value]) -> list[Value]:
        """Of two vectors, the sum with the first two factors and that with the last two."""
        uu, uv, vu, vv = map(self.repeat, factors)
        u, v = two
        return [self.plus(self.times(p, u), self.times(q, v)) for p, q in ((uu, uv), (vu, vv))]

    def outer(self, diagonal: Value, lefts: list[Value], rights: list[Value]) -> list[Value]:
        """Rows of diagonal I + Σ left rightᵀ."""
        rows = []
        for i in range(3):
            row = self.builder.insert_element(ir.Constant(self.vector, [0.0] * WIDTH), diagonal, LANE(i))
            for left, right in zip(lefts, rights, strict=True):
                row = self.plus(row, self.times(self.pick(left, left, i, i, i, i), right))
            rows.append(row)
        return rows

    def minus_sum(self, one: list[Value], other: list[Value]) -> list[Value]:
        """Of the rows of two blocks."""
        return [self.builder.fneg(self.plus(p, q)) for p, q in zip(one, other, strict=True)]

    def packed(self, rows: list[Value]) -> list[Value]:
        """The first eight numbers of a block, row by row."""
        one, two, three = rows
        return [self.pick(one, two, 0, 1, 2, 4), self.pick(two, three, 1, 2, 4, 5)]

    def packed_columns(self, rows: list[Value]) -> list[Value]:
        """The first eight numbers of a block, column by column."""
        one, two, three = rows
        last, below = self.pick(one, two, 2, 6, 2, 6), self.pick(two, three, 1, 5, 1, 5)
        first = self.pick(self.pick(one, two, 0, 4, 1, 5), three, 0, 1, 4, 2)
        return [first, self.pick(below, last, 0, 1, 4, 5)]

    def add_block(self, block: Value, eight: list[Value], row: Value) -> None:
        """Add to a block in memory its first eight numbers, and the third of its last row."""
        for i, numbers in enumerate(eight):
            target = self.builder.gep(block, [INDEX(WIDTH * i)])
            self.store(self.plus(self.load(target), numbers), target)
        target = self.builder.gep(block, [INDEX(8)])
        corner = self.builder.extract_element(row, LANE(2))
        self.builder.store(self.plus(self.builder.load(target), corner), target)

    def six_offsets(self) -> list[Value]:
        """Those of the couplings (0, 0), (0, 1), …, (2, 2) of element ``e``, in ``offsets`` (E, 6)."""
        row = self.at(self.begin("offsets"), self.integer("e"), 6)
        return [self.builder.load(self.builder.gep(row, [INDEX(pair)])) for pair in range(6)]

    def is_odd(self, offset: Value) -> Value:
        """In all lanes, as processors choose between vectors without a jump."""
        odd = self.builder.trunc(offset, ir.IntType(1))
        one = self.builder.insert_element(
            ir.Constant(ir.VectorType(odd.type, WIDTH), ir.Undefined), odd, LANE(0)
        )
        return self.pick(one, one, 0, 0, 0, 0)

    def add_six(self, offsets: list[Value], blocks: list[list[Value]]) -> None:
        """Add the rows of six blocks of an element as they are, where offsets say."""
        builder, begin = self.builder, self.begin("blocks")
        ready = [(self.packed(rows), rows[2]) for rows in blocks]

        def add(pair: int) -> None:
            at = builder.ashr(offsets[pair], offsets[pair].type(1))
            at = at if at.type == INDEX else builder.sext(at, INDEX)
            self.add_block(self.at(begin, at, 9), *ready[pair])

        # whoever has the rows of all three points has all blocks
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
