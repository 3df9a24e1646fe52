"""SIMD operations on 3×3 blocks, and prefetching, as LLVM code that numba calls.

Numba leaves these loops scalar. Blocks are (n_blocks, 9), column by column; a row of blocks is multiplied
one column of a block at a time. A fourth number is read and computed with each three; of the blocks it is
always one of the same block. ``tests/kernels/plain_vectors.py`` has the same functions in plain numba;
docs/performance.md says what the difference is.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types
from numba.core.errors import TypingError
from numba.extending import intrinsic

from lyra_petsc.kernels.llvm import INDEX, LANE, WIDTH, Code

AHEAD = 64
"""Blocks by which they are fetched before they are used: in a sweep each row waits for the one before it."""


def _check(*arrays: Any) -> None:
    kinds = {array.dtype for array in arrays}
    if len(kinds) > 1 or any(array.layout != "C" or array.ndim != 2 for array in arrays):
        raise TypingError("contiguous arrays of two dimensions and one type are expected")


def _without_result(write: Callable[[Code], None], **given: Any) -> Any:
    """What numba takes of an operation with these arguments, which ``write`` writes."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        write(Code(context, builder, signature, arguments, " ".join(given)))
        return context.get_dummy_value()

    return types.void(*given.values()), generate


def _gather(typing: Any, blocks: Any, columns: Any, x: Any, lo: Any, hi: Any, ahead: Any) -> Any:
    """Sum of blocks[k] x[columns[k]] for lo ≤ k < hi, three numbers; x (n, 3).

    Each time the block is fetched that will be needed ``ahead`` blocks later.
    """
    _check(blocks, x)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        code = Code(context, builder, signature, arguments, "blocks columns x lo hi ahead")
        block_rows, numbers, vectors = code.begin("blocks"), code.begin("columns"), code.begin("x")
        ahead = code.integer("ahead")
        zero = ir.Constant(code.vector, [0.0] * WIDTH)
        sums = [cgutils.alloca_once_value(builder, zero) for _ in range(3)]  # type: ignore[no-untyped-call]
        with code.loop() as (k, _):
            code.fetch(code.at(block_rows, builder.add(k, ahead), 9))
            source = code.at(vectors, code.number(numbers, k), 3)
            for i, column in enumerate(code.columns(code.at(block_rows, k, 9))):
                factor = code.repeat(builder.load(builder.gep(source, [INDEX(i)])))
                builder.store(code.plus(builder.load(sums[i]), code.times(column, factor)), sums[i])
        one, two, three = map(builder.load, sums)
        total = code.plus(code.plus(one, two), three)
        found = [builder.extract_element(total, LANE(i)) for i in range(3)]
        return context.make_tuple(builder, signature.return_type, found)

    three = types.UniTuple(blocks.dtype, 3)  # type: ignore[no-untyped-call]
    return three(blocks, columns, x, lo, hi, ahead), generate


def _scatter(typing: Any, blocks: Any, columns: Any, out: Any, lo: Any, hi: Any, factors: Any) -> Any:
    """out[columns[k]] += blocks[k]ᵀ factors for lo ≤ k < hi; out (n, 4), its last column is padding."""
    _check(blocks, out)

    def write(code: Code) -> None:
        block_rows, numbers, vectors = code.begin("blocks"), code.begin("columns"), code.begin("out")
        row = code.filled(code.numbers("factors"))
        with code.loop() as (k, _):
            a, b, c = (code.times(column, row) for column in code.columns(code.at(block_rows, k, 9)))
            # the sums of a, b and c, without their padding
            ab, last = code.pick(a, b, 0, 4, 1, 5), code.pick(a, b, 2, 6, 2, 6)
            first, second = code.pick(ab, c, 0, 1, 4, 4), code.pick(ab, c, 2, 3, 5, 5)
            total = code.plus(code.plus(first, second), code.pick(last, c, 0, 1, 6, 6))
            target = code.at(vectors, code.number(numbers, k), WIDTH)
            code.store(code.plus(code.load(target), total), target)

    return _without_result(write, blocks=blocks, columns=columns, out=out, lo=lo, hi=hi, factors=factors)


def _gather_edges(typing: Any, blocks: Any, places: Any, x: Any, lo: Any, hi: Any, ahead: Any) -> Any:
    """Sum of blocks[k] x[places[k]] for lo ≤ k < hi, three numbers; x in its flat form.

    A block (3 × 4), row by row, is the coupling of a point with four edges, whose ``places`` (n, 4) are.
    """
    _check(blocks, x)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        code = Code(context, builder, signature, arguments, "blocks places x lo hi ahead")
        block_rows, numbers, vectors = code.begin("blocks"), code.begin("places"), code.begin("x")
        ahead = code.integer("ahead")
        zero = ir.Constant(code.vector, [0.0] * WIDTH)
        sums = [cgutils.alloca_once_value(builder, zero) for _ in range(3)]  # type: ignore[no-untyped-call]
        with code.loop() as (k, _):
            code.fetch(code.at(block_rows, builder.add(k, ahead), 12))
            block, four = code.at(block_rows, k, 12), code.at(numbers, k, WIDTH)
            sources = [code.at(vectors, code.number(four, INDEX(i)), 1) for i in range(WIDTH)]
            factors = code.filled([builder.load(source) for source in sources])
            for i in range(3):
                part = code.times(code.load(builder.gep(block, [INDEX(WIDTH * i)])), factors)
                builder.store(code.plus(builder.load(sums[i]), part), sums[i])
        a, b, c = map(builder.load, sums)
        ab = code.plus(code.pick(a, b, 0, 1, 4, 5), code.pick(a, b, 2, 3, 6, 7))
        cc = code.plus(c, code.pick(c, c, 2, 3, 2, 3))
        total = code.plus(code.pick(ab, cc, 0, 2, 4, 4), code.pick(ab, cc, 1, 3, 5, 5))
        found = [builder.extract_element(total, LANE(i)) for i in range(3)]
        return context.make_tuple(builder, signature.return_type, found)

    three = types.UniTuple(blocks.dtype, 3)  # type: ignore[no-untyped-call]
    return three(blocks, places, x, lo, hi, ahead), generate


def _scatter_edges(typing: Any, blocks: Any, places: Any, out: Any, lo: Any, hi: Any, factors: Any) -> Any:
    """out[places[k]] += blocks[k]ᵀ factors for lo ≤ k < hi, as ``gather_edges`` has them."""
    _check(blocks, out)

    def write(code: Code) -> None:
        block_rows, numbers, vectors = code.begin("blocks"), code.begin("places"), code.begin("out")
        factors = [code.repeat(number) for number in code.numbers("factors")]
        with code.loop() as (k, _):
            block, four = code.at(block_rows, k, 12), code.at(numbers, k, WIDTH)
            rows = [code.load(code.builder.gep(block, [INDEX(WIDTH * i)])) for i in range(3)]
            total = code.summed(*zip(rows, factors, strict=True))
            for i in range(WIDTH):  # one after the other: an edge may be there twice, with a coupling of 0
                target = code.at(vectors, code.number(four, INDEX(i)), 1)
                more = code.builder.extract_element(total, LANE(i))
                code.builder.store(code.plus(code.builder.load(target), more), target)

    return _without_result(write, blocks=blocks, places=places, out=out, lo=lo, hi=hi, factors=factors)


def _add_outers(typing: Any, blocks: Any, at: Any, diagonal: Any, pairs: Any) -> Any:
    """blocks[at // 2] += diagonal I + Σ left rightᵀ, transposed where ``at`` is odd; nothing where negative.

    ``pairs`` is a tuple of pairs of three numbers each, left and right.
    """

    def write(code: Code) -> None:
        at, begin, diagonal = code.integer("at"), code.begin("blocks"), code.given["diagonal"]
        with code.builder.if_then(code.is_ours(at), likely=True):
            products = [code.outer(*code.swapped(at, *pair)) for pair in code.pairs("pairs")]
            eights, ninths = zip(*products, strict=True)
            eight, ninth = reduce(code.plus, eights), reduce(code.plus, ninths, diagonal)
            eight = code.plus(eight, code.identity(diagonal))
            code.add_block(code.at(begin, code.builder.ashr(at, INDEX(1)), 9), eight, ninth)

    return _without_result(write, blocks=blocks, at=at, diagonal=diagonal, pairs=pairs)


def _add_six(typing: Any, blocks: Any, offsets: Any, e: Any, n: Any, six: Any) -> Any:
    """Add the blocks n Rᵀ + L nᵀ of the couplings (0, 0), (0, 1), …, (2, 2) of an element e.

    They are given by R and L, tuples of three numbers or sums: of pairs of a factor and three numbers; n is
    three numbers. Offsets (E, 6) are a pattern's.
    """

    def write(code: Code) -> None:
        n = code.filled(code.numbers("n"))
        n_left, n_right, offsets, blocks = code.spread(n), code.tiled(n), code.six_offsets(), []
        for offset, (right, left) in zip(offsets, code.pairs("six"), strict=True):
            ninth = code.third(code.times(n, code.plus(left, right)))
            right, left = code.swapped(offset, right, left)  # transposed: n Lᵀ + R nᵀ
            eight = code.summed((n_left, code.tiled(right)), (code.spread(left), n_right))
            blocks.append((eight, ninth))
        code.add_six(offsets, blocks)

    return _without_result(write, blocks=blocks, offsets=offsets, e=e, n=n, six=six)


def _add_triangle(typing: Any, blocks: Any, offsets: Any, e: Any, f: Any, three: Any) -> Any:
    """Add the blocks of the couplings of an element e whose rows and columns of blocks sum to zero.

    Given are those of (1, 1), (1, 2), (2, 2) as factors (uu, uv, vu, vv, g) of two vectors: a block is
    uu fu fuᵀ + uv fu fvᵀ + vu fv fuᵀ + vv fv fvᵀ + g I. Offsets (E, 6) are those of a pattern.
    """

    def write(code: Code) -> None:
        u, v = code.vectors("f")
        (uu, uu9), (uv, uv9), (vv, vv9) = code.outer(u, u), code.outer(u, v), code.outer(v, v)
        vu, made = code.transposed(uv), []
        for a, b, c, d, g in code.tuples("three"):
            ninth = code.plus(code.summed((a, uu9), (code.builder.fadd(b, c), uv9), (d, vv9)), g)
            a, b, c, d = (code.repeat(factor, 8) for factor in (a, b, c, d))
            eight = code.summed((a, uu), (b, uv), (c, vu), (d, vv))
            made.append((code.plus(eight, code.identity(g)), ninth))
        _add_balanced(code, code.six_offsets(), made)

    return _without_result(write, blocks=blocks, offsets=offsets, e=e, f=f, three=three)


def _add_balanced(code: Code, offsets: list[Any], three: list[Any]) -> None:
    """Add six blocks whose rows and columns sum to zero; given are those of (1, 1), (1, 2), (2, 2)."""
    (b11, one), (b12, two), (b22, last) = three
    b21 = code.transposed(b12)
    b01 = code.minus_sum(b11, code.swapped(offsets[1], b21, b12)[0]), code.minus_sum(one, two)
    b02 = code.minus_sum(b22, code.swapped(offsets[2], b12, b21)[0]), code.minus_sum(two, last)
    b00 = reduce(code.plus, (b11, b12, b21, b22)), reduce(code.plus, (one, two, two, last))
    stored = code.swapped(offsets[4], b12, b21)[0], two
    code.add_six(offsets, [b00, b01, b02, (b11, one), stored, (b22, last)])


def _add_corners(typing: Any, blocks: Any, offsets: Any, e: Any, three: Any) -> Any:
    """Add the blocks of the couplings of an element e whose rows and columns of blocks sum to zero.

    Given are those of (1, 1), (1, 2), (2, 2), nine numbers each. Offsets (E, 6) are those of a pattern.
    """

    def write(code: Code) -> None:
        made = [(code.filled(nine[:8], code.eight), nine[8]) for nine in code.tuples("three")]
        _add_balanced(code, code.six_offsets(), made)

    return _without_result(write, blocks=blocks, offsets=offsets, e=e, three=three)


def _put(typing: Any, blocks: Any, k: Any, out: Any, at: Any) -> Any:
    """out[at // 2] = blocks[k], transposed where ``at`` is odd; both (n, 9)."""
    _check(blocks, out)

    def write(code: Code) -> None:
        builder, at = code.builder, code.integer("at")
        source = code.at(code.begin("blocks"), code.integer("k"), 9)
        target = code.at(code.begin("out"), builder.ashr(at, INDEX(1)), 9)
        eight, last = code.load(source, code.eight), INDEX(8)
        code.store(code.swapped(at, eight, code.transposed(eight))[0], target)
        builder.store(builder.load(builder.gep(source, [last])), builder.gep(target, [last]))

    return _without_result(write, blocks=blocks, k=k, out=out, at=at)


def _fetch(typing: Any, blocks: Any, k: Any) -> Any:
    """Let block k come into the caches; there need be no such block."""

    def write(code: Code) -> None:
        block = code.at(code.begin("blocks"), code.integer("k"), 9)
        for last in (0, 8):  # it may lie on two cache lines
            code.fetch(code.builder.gep(block, [INDEX(last)]))

    return _without_result(write, blocks=blocks, k=k)


# their callers leave out ``typing``
gather: Any = intrinsic(_gather)
gather_edges: Any = intrinsic(_gather_edges)
add_corners: Any = intrinsic(_add_corners)
add_outers: Any = intrinsic(_add_outers)
add_six: Any = intrinsic(_add_six)
add_triangle: Any = intrinsic(_add_triangle)
fetch: Any = intrinsic(_fetch)
put: Any = intrinsic(_put)
scatter: Any = intrinsic(_scatter)
scatter_edges: Any = intrinsic(_scatter_edges)
