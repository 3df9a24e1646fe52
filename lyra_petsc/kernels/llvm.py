"""Generation of LLVM code: vectors of four numbers, and of eight of the nine numbers of a 3 × 3 block."""

from __future__ import annotations

from functools import reduce
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types

WIDTH = 4
"""Numbers in a vector."""

FLAGS = ("contract", "nsz")
"""Permitted changes of sums and products: they may be fused, and the sign of zero may be ignored."""

Value = Any
"""A value or a pointer in LLVM's intermediate representation."""

INDEX, LANE = ir.IntType(64), ir.IntType(32)


class CodeBuilder:
    """Builds the code of one call with named arguments."""

    def __init__(self, context: Any, builder: Any, signature: Any, arguments: Any, names: str) -> None:
        self._context, self.builder = context, builder
        self.arguments = dict(zip(names.split(), arguments, strict=True))
        self._types = dict(zip(names.split(), signature.args, strict=True))
        number = context.get_value_type(self._types["blocks"].dtype)
        self.vector4, self.vector8 = ir.VectorType(number, WIDTH), ir.VectorType(number, 8)

    def array_pointer(self, name: str) -> Value:
        """Pointer to the first entry of an array."""
        made = self._context.make_array(self._types[name])
        return made(self._context, self.builder, self.arguments[name]).data

    def integer(self, name: str) -> Value:
        return self._context.cast(self.builder, self.arguments[name], self._types[name], types.int64)

    def row_pointer(self, begin: Value, row: Value, width: int) -> Value:
        """Pointer to a row of an array with ``width`` columns."""
        return self.builder.gep(begin, [self.builder.mul(row, INDEX(width))])

    def index_entry(self, begin: Value, position: Value) -> Value:
        """An entry of an array of indices, as a 64-bit integer."""
        entry = self.builder.load(self.builder.gep(begin, [position]))
        return entry if entry.type == INDEX else self.builder.zext(entry, INDEX)

    def load(self, pointer: Value, kind: Any = None) -> Value:
        """A vector (of four numbers by default) of the numbers in memory from a pointer on."""
        kind = self.vector4 if kind is None else kind
        vector = self.builder.load(self.builder.bitcast(pointer, kind.as_pointer()))
        vector.align = self._size
        return vector

    def store(self, vector: Value, pointer: Value) -> None:
        self.builder.store(vector, self.builder.bitcast(pointer, vector.type.as_pointer())).align = self._size

    @property
    def _size(self) -> int:
        return 8 if isinstance(self.vector4.element, ir.DoubleType) else 4

    def shuffle(self, one: Value, other: Value, *lanes: int) -> Value:
        """A vector of the given lanes of two vectors; lanes of the second are numbered after those of the
        first.
        """
        kind = ir.VectorType(LANE, len(lanes))
        return self.builder.shuffle_vector(one, other, ir.Constant(kind, list(lanes)))

    def undefined(self, kind: Any = None) -> Value:
        return ir.Constant(self.vector4 if kind is None else kind, ir.Undefined)

    def vectors(self, name: str) -> list[Value]:
        """Vectors of the elements of a tuple: each is three numbers, or a sum of pairs of a factor and three
        numbers.
        """
        return self._vectors_of(self.arguments[name], self._types[name])

    def vector_pairs(self, name: str) -> list[list[Value]]:
        """The same for a tuple of pairs."""
        of_pairs = zip(self._unpack(self.arguments[name]), self._types[name], strict=True)
        return [self._vectors_of(pair, kinds) for pair, kinds in of_pairs]

    def _vectors_of(self, pair: Value, kinds: Any) -> list[Value]:
        return [self._vector_of_sum(one, kind) for one, kind in zip(self._unpack(pair), kinds, strict=True)]

    def _vector_of_sum(self, terms: Value, kind: Any) -> Value:
        if not isinstance(kind[0], types.BaseTuple):
            return self.vector_of(self._unpack(terms))
        pairs = map(self._unpack, self._unpack(terms))
        parts = [self.mul(self.splat(factor), self.vector_of(self._unpack(of))) for factor, of in pairs]
        return reduce(self.add, parts)

    def _unpack(self, values: Value) -> list[Value]:
        return cgutils.unpack_tuple(self.builder, values)  # type: ignore[no-untyped-call]

    def vector_of(self, numbers: list[Value], kind: Any = None) -> Value:
        """A vector (of four numbers by default) that begins with these numbers; the rest is undefined."""
        vector = self.undefined(kind)
        for i, number in enumerate(numbers):
            vector = self.builder.insert_element(vector, number, LANE(i))
        return vector

    def splat(self, scalar: Value, width: int = WIDTH) -> Value:
        """A vector with the same number in all lanes."""
        first = self.builder.insert_element(self.undefined(), scalar, LANE(0))
        return self.shuffle(first, self.undefined(), *[0] * width)

    def columns(self, block: Value) -> list[Value]:
        """The three columns of a block, without reading beyond it."""
        one, two, last = (self.load(self.builder.gep(block, [INDEX(first)])) for first in (0, 3, 5))
        return [one, two, self.shuffle(last, self.undefined(), 1, 2, 3, 3)]

    def mul(self, one: Value, other: Value) -> Value:
        return self.builder.fmul(one, other, flags=FLAGS)

    def add(self, one: Value, other: Value) -> Value:
        return self.builder.fadd(one, other, flags=FLAGS)

    def tuple_values(self, name: str) -> list[Value]:
        """The elements of a tuple."""
        return self._unpack(self.arguments[name])

    def nested_values(self, name: str) -> list[list[Value]]:
        """The elements of the tuples in a tuple."""
        return [self._unpack(one) for one in self.tuple_values(name)]

    def left_factors(self, vector: Value) -> Value:
        """The left factors of the first eight entries of left rightᵀ, row by row."""
        return self.shuffle(vector, vector, 0, 0, 0, 1, 1, 1, 2, 2)

    def right_factors(self, vector: Value) -> Value:
        """The right factors of the first eight entries of left rightᵀ, row by row."""
        return self.shuffle(vector, vector, 0, 1, 2, 0, 1, 2, 0, 1)

    def outer(self, left: Value, right: Value) -> tuple[Value, Value]:
        """left rightᵀ: its first eight entries, row by row, and its last."""
        eight = self.mul(self.left_factors(left), self.right_factors(right))
        return eight, self.third(self.mul(left, right))

    def identity(self, factor: Value) -> Value:
        """The first eight entries of a factor times the identity."""
        first = self.builder.insert_element(ir.Constant(self.vector8, [0.0] * 8), factor, LANE(0))
        return self.builder.insert_element(first, factor, LANE(4))

    def transposed(self, eight: Value) -> Value:
        """The first eight entries of a transposed block; the last is the same."""
        return self.shuffle(eight, eight, 0, 3, 6, 1, 4, 7, 2, 5)

    def negative_sum(self, one: Value, other: Value) -> Value:
        return self.builder.fneg(self.add(one, other))

    def third(self, vector: Value) -> Value:
        return self.builder.extract_element(vector, LANE(2))

    def sum_of_products(self, *products: tuple[Value, Value]) -> Value:
        return reduce(self.add, [self.mul(one, other) for one, other in products])

    def order_by_parity(self, offset: Value, one: Value, other: Value) -> tuple[Value, Value]:
        """Two vectors, in reverse order if the offset is odd (the block is added transposed)."""
        odd = self.is_odd(offset, one.type.count)
        return self.builder.select(odd, other, one), self.builder.select(odd, one, other)

    def add_block(self, block: Value, eight: Value, ninth: Value) -> None:
        """Add the first eight entries and the last to a block in memory."""
        self.store(self.add(self.load(block, self.vector8), eight), block)
        last = self.builder.gep(block, [INDEX(8)])
        self.builder.store(self.add(self.builder.load(last), ninth), last)

    def six_offsets(self) -> list[Value]:
        """Offsets of the couplings (0, 0), (0, 1), …, (2, 2) of element ``e``, from ``offsets`` (E, 6)."""
        row = self.row_pointer(self.array_pointer("offsets"), self.integer("e"), 6)
        return [self.builder.load(self.builder.gep(row, [INDEX(pair)])) for pair in range(6)]

    def is_odd(self, offset: Value, width: int) -> Value:
        """Whether the offset is odd, in all lanes: vectors are then selected without a branch."""
        odd = self.builder.trunc(offset, ir.IntType(1))
        one = self.builder.insert_element(
            ir.Constant(ir.VectorType(odd.type, width), ir.Undefined), odd, LANE(0)
        )
        return self.shuffle(one, one, *[0] * width)

    def add_six(self, offsets: list[Value], blocks: list[tuple[Value, Value]]) -> None:
        """Add the six blocks of an element, each as for `add_block`, at their offsets."""
        builder, begin = self.builder, self.array_pointer("blocks")

        def add(pair: int) -> None:
            at = builder.ashr(offsets[pair], offsets[pair].type(1))
            at = at if at.type == INDEX else builder.sext(at, INDEX)
            self.add_block(self.row_pointer(begin, at, 9), *blocks[pair])

        # if the diagonal blocks are stored on this rank, all are
        own = builder.or_(builder.or_(offsets[0], offsets[3]), offsets[5])
        with builder.if_else(self.is_stored(own), likely=True) as (all_of_them, some):
            with all_of_them:
                for pair in range(6):
                    add(pair)
            with some:
                for pair in range(6):
                    with builder.if_then(self.is_stored(offsets[pair])):
                        add(pair)

    def is_stored(self, offset: Value) -> Value:
        return self.builder.icmp_signed(">=", offset, offset.type(0))

    def prefetch(self, pointer: Value) -> None:
        """Prefetch memory into the caches; the address need not be valid."""
        byte = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [byte, LANE, LANE, LANE])
        function = self.builder.module.declare_intrinsic("llvm.prefetch", [byte], kind)
        how = LANE(0), LANE(3), LANE(1)  # for reading, into all caches, data and not instructions
        self.builder.call(function, [self.builder.bitcast(pointer, byte), *how])

    def loop(self) -> Any:
        """A loop over the blocks from ``lo`` to ``hi``."""
        return cgutils.for_range_slice(
            self.builder, self.integer("lo"), self.integer("hi"), INDEX(1), intp=INDEX
        )
