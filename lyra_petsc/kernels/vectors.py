"""SIMD operations on 3×3 blocks, and prefetching, as LLVM code that numba calls.

Numba does not vectorise these loops. Blocks are (n_blocks, 9), column by column; a row of blocks is
multiplied one column of a block at a time. With three numbers a fourth is read and computed; for blocks it
always belongs to the same block; docs/notes/performance.md says what the difference to plain numba is.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types
from numba.core.errors import TypingError
from numba.extending import intrinsic

from lyra_petsc.kernels.llvm import INDEX, LANE, WIDTH, CodeBuilder

AHEAD = 64
"""Number of blocks by which prefetching runs ahead: in a sweep each row waits for the previous one."""


def _check(*arrays: Any) -> None:
    kinds = {array.dtype for array in arrays}
    if len(kinds) > 1 or any(array.layout != "C" or array.ndim != 2 for array in arrays):
        raise TypingError("contiguous arrays of two dimensions and one type are expected")


def _without_result(write: Callable[[CodeBuilder], None], **kinds: Any) -> Any:
    """The signature and generator that numba expects of an operation without result, whose code ``write``
    builds.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        write(CodeBuilder(context, builder, signature, arguments, " ".join(kinds)))
        return context.get_dummy_value()

    return types.void(*kinds.values()), generate


def _gather(typing: Any, blocks: Any, columns: Any, x: Any, lo: Any, hi: Any, ahead: Any) -> Any:
    """Sum of blocks[k] x[columns[k]] for lo ≤ k < hi, three numbers; x (n, 3).

    With each block the one ``ahead`` blocks later is prefetched.
    """
    _check(blocks, x)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        code = CodeBuilder(context, builder, signature, arguments, "blocks columns x lo hi ahead")
        block_rows, numbers, vectors = map(code.array_pointer, ("blocks", "columns", "x"))
        ahead = code.integer("ahead")
        zero = ir.Constant(code.vector4, [0.0] * WIDTH)
        sums = [cgutils.alloca_once_value(builder, zero) for _ in range(3)]  # type: ignore[no-untyped-call]
        with code.loop() as (k, _):
            code.prefetch(code.row_pointer(block_rows, builder.add(k, ahead), 9))
            source = code.row_pointer(vectors, code.index_entry(numbers, k), 3)
            for i, column in enumerate(code.columns(code.row_pointer(block_rows, k, 9))):
                factor = code.splat(builder.load(builder.gep(source, [INDEX(i)])))
                builder.store(code.add(builder.load(sums[i]), code.mul(column, factor)), sums[i])
        one, two, three = map(builder.load, sums)
        total = code.add(code.add(one, two), three)
        numbers = [builder.extract_element(total, LANE(i)) for i in range(3)]
        return context.make_tuple(builder, signature.return_type, numbers)

    three = types.UniTuple(blocks.dtype, 3)  # type: ignore[no-untyped-call]
    return three(blocks, columns, x, lo, hi, ahead), generate


def _scatter(typing: Any, blocks: Any, columns: Any, out: Any, lo: Any, hi: Any, factors: Any) -> Any:
    """out[columns[k]] += blocks[k]ᵀ factors for lo ≤ k < hi; out (n, 4), its last column is padding."""
    _check(blocks, out)

    def write(code: CodeBuilder) -> None:
        block_rows, numbers, vectors = map(code.array_pointer, ("blocks", "columns", "out"))
        row = code.vector_of(code.tuple_values("factors"))
        with code.loop() as (k, _):
            columns = code.columns(code.row_pointer(block_rows, k, 9))
            a, b, c = (code.mul(column, row) for column in columns)
            # the sums of a, b and c, without their padding
            ab, last = code.shuffle(a, b, 0, 4, 1, 5), code.shuffle(a, b, 2, 6, 2, 6)
            first, second = code.shuffle(ab, c, 0, 1, 4, 4), code.shuffle(ab, c, 2, 3, 5, 5)
            total = code.add(code.add(first, second), code.shuffle(last, c, 0, 1, 6, 6))
            target = code.row_pointer(vectors, code.index_entry(numbers, k), WIDTH)
            code.store(code.add(code.load(target), total), target)

    return _without_result(write, blocks=blocks, columns=columns, out=out, lo=lo, hi=hi, factors=factors)


def _gather_edges(typing: Any, blocks: Any, indices: Any, x: Any, lo: Any, hi: Any, ahead: Any) -> Any:
    """Sum of blocks[k] x[indices[k]] for lo ≤ k < hi, three numbers; x in its flat form.

    A block (3 × 4), row by row, couples a point with four edges, whose unknowns are at ``indices`` (n, 4).
    """
    _check(blocks, x)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        code = CodeBuilder(context, builder, signature, arguments, "blocks indices x lo hi ahead")
        block_rows, numbers, vectors = map(code.array_pointer, ("blocks", "indices", "x"))
        ahead = code.integer("ahead")
        zero = ir.Constant(code.vector4, [0.0] * WIDTH)
        sums = [cgutils.alloca_once_value(builder, zero) for _ in range(3)]  # type: ignore[no-untyped-call]
        with code.loop() as (k, _):
            code.prefetch(code.row_pointer(block_rows, builder.add(k, ahead), 12))
            block, four = code.row_pointer(block_rows, k, 12), code.row_pointer(numbers, k, WIDTH)
            sources = [code.row_pointer(vectors, code.index_entry(four, INDEX(i)), 1) for i in range(WIDTH)]
            factors = code.vector_of([builder.load(source) for source in sources])
            for i in range(3):
                part = code.mul(code.load(builder.gep(block, [INDEX(WIDTH * i)])), factors)
                builder.store(code.add(builder.load(sums[i]), part), sums[i])
        a, b, c = map(builder.load, sums)
        ab = code.add(code.shuffle(a, b, 0, 1, 4, 5), code.shuffle(a, b, 2, 3, 6, 7))
        cc = code.add(c, code.shuffle(c, c, 2, 3, 2, 3))
        total = code.add(code.shuffle(ab, cc, 0, 2, 4, 4), code.shuffle(ab, cc, 1, 3, 5, 5))
        numbers = [builder.extract_element(total, LANE(i)) for i in range(3)]
        return context.make_tuple(builder, signature.return_type, numbers)

    three = types.UniTuple(blocks.dtype, 3)  # type: ignore[no-untyped-call]
    return three(blocks, indices, x, lo, hi, ahead), generate


def _scatter_edges(typing: Any, blocks: Any, indices: Any, out: Any, lo: Any, hi: Any, factors: Any) -> Any:
    """out[indices[k]] += blocks[k]ᵀ factors for lo ≤ k < hi; blocks and indices as for ``gather_edges``."""
    _check(blocks, out)

    def write(code: CodeBuilder) -> None:
        block_rows, numbers, vectors = map(code.array_pointer, ("blocks", "indices", "out"))
        factors = [code.splat(number) for number in code.tuple_values("factors")]
        with code.loop() as (k, _):
            block, four = code.row_pointer(block_rows, k, 12), code.row_pointer(numbers, k, WIDTH)
            rows = [code.load(code.builder.gep(block, [INDEX(WIDTH * i)])) for i in range(3)]
            total = code.sum_of_products(*zip(rows, factors, strict=True))
            for i in range(WIDTH):  # one after the other, since an edge may occur twice, with a coupling of 0
                target = code.row_pointer(vectors, code.index_entry(four, INDEX(i)), 1)
                more = code.builder.extract_element(total, LANE(i))
                code.builder.store(code.add(code.builder.load(target), more), target)

    return _without_result(write, blocks=blocks, indices=indices, out=out, lo=lo, hi=hi, factors=factors)


def _add_outers(typing: Any, blocks: Any, at: Any, diagonal: Any, pairs: Any) -> Any:
    """blocks[at // 2] += diagonal I + Σ left rightᵀ, transposed if ``at`` is odd; nothing if it is negative.

    ``pairs`` is a tuple of pairs (left, right) of three numbers each.
    """

    def write(code: CodeBuilder) -> None:
        at, begin, diagonal = code.integer("at"), code.array_pointer("blocks"), code.arguments["diagonal"]
        with code.builder.if_then(code.is_stored(at), likely=True):
            products = [code.outer(*code.order_by_parity(at, *pair)) for pair in code.vector_pairs("pairs")]
            eights, ninths = zip(*products, strict=True)
            eight, ninth = reduce(code.add, eights), reduce(code.add, ninths, diagonal)
            eight = code.add(eight, code.identity(diagonal))
            code.add_block(code.row_pointer(begin, code.builder.ashr(at, INDEX(1)), 9), eight, ninth)

    return _without_result(write, blocks=blocks, at=at, diagonal=diagonal, pairs=pairs)


def _add_six(typing: Any, blocks: Any, offsets: Any, e: Any, n: Any, six: Any) -> Any:
    """Add the blocks n Rᵀ + L nᵀ of the couplings (0, 0), (0, 1), …, (2, 2) of an element e.

    ``six`` are pairs (R, L) of three numbers, or of sums of pairs of a factor and three numbers; n is three
    numbers. Offsets (E, 6) are those of a pattern.
    """

    def write(code: CodeBuilder) -> None:
        n = code.vector_of(code.tuple_values("n"))
        n_left, n_right, offsets, blocks = code.left_factors(n), code.right_factors(n), code.six_offsets(), []
        for offset, (right, left) in zip(offsets, code.vector_pairs("six"), strict=True):
            ninth = code.third(code.mul(n, code.add(left, right)))
            right, left = code.order_by_parity(offset, right, left)  # transposed: n Lᵀ + R nᵀ
            products = (n_left, code.right_factors(right)), (code.left_factors(left), n_right)
            eight = code.sum_of_products(*products)
            blocks.append((eight, ninth))
        code.add_six(offsets, blocks)

    return _without_result(write, blocks=blocks, offsets=offsets, e=e, n=n, six=six)


def _add_triangle(typing: Any, blocks: Any, offsets: Any, e: Any, f: Any, three: Any) -> Any:
    """Add the blocks of the couplings of an element e whose rows and columns of blocks sum to zero.

    ``three`` are the blocks (1, 1), (1, 2), (2, 2) as factors (uu, uv, vu, vv, g) for two vectors f: a block
    is uu fu fuᵀ + uv fu fvᵀ + vu fv fuᵀ + vv fv fvᵀ + g I. Offsets (E, 6) are those of a pattern.
    """

    def write(code: CodeBuilder) -> None:
        u, v = code.vectors("f")
        (uu, uu9), (uv, uv9), (vv, vv9) = code.outer(u, u), code.outer(u, v), code.outer(v, v)
        vu, made = code.transposed(uv), []
        for a, b, c, d, g in code.nested_values("three"):
            ninth = code.add(code.sum_of_products((a, uu9), (code.builder.fadd(b, c), uv9), (d, vv9)), g)
            a, b, c, d = (code.splat(factor, 8) for factor in (a, b, c, d))
            eight = code.sum_of_products((a, uu), (b, uv), (c, vu), (d, vv))
            made.append((code.add(eight, code.identity(g)), ninth))
        _add_balanced(code, code.six_offsets(), made)

    return _without_result(write, blocks=blocks, offsets=offsets, e=e, f=f, three=three)


def _add_balanced(code: CodeBuilder, offsets: list[Any], three: list[Any]) -> None:
    """Add six blocks whose rows and columns sum to zero, given (1, 1), (1, 2) and (2, 2)."""
    (b11, one), (b12, two), (b22, last) = three
    b21 = code.transposed(b12)
    b01 = code.negative_sum(b11, code.order_by_parity(offsets[1], b21, b12)[0]), code.negative_sum(one, two)
    b02 = code.negative_sum(b22, code.order_by_parity(offsets[2], b12, b21)[0]), code.negative_sum(two, last)
    b00 = reduce(code.add, (b11, b12, b21, b22)), reduce(code.add, (one, two, two, last))
    stored = code.order_by_parity(offsets[4], b12, b21)[0], two
    code.add_six(offsets, [b00, b01, b02, (b11, one), stored, (b22, last)])


def _add_corners(typing: Any, blocks: Any, offsets: Any, e: Any, three: Any) -> Any:
    """Add the blocks of the couplings of an element e whose rows and columns of blocks sum to zero.

    ``three`` are the blocks (1, 1), (1, 2), (2, 2), nine numbers each. Offsets (E, 6) are those of a pattern.
    """

    def write(code: CodeBuilder) -> None:
        made = [(code.vector_of(nine[:8], code.vector8), nine[8]) for nine in code.nested_values("three")]
        _add_balanced(code, code.six_offsets(), made)

    return _without_result(write, blocks=blocks, offsets=offsets, e=e, three=three)


def _store_block(typing: Any, blocks: Any, k: Any, out: Any, at: Any) -> Any:
    """out[at // 2] = blocks[k], transposed if ``at`` is odd; both arrays are (n, 9)."""
    _check(blocks, out)

    def write(code: CodeBuilder) -> None:
        builder, at = code.builder, code.integer("at")
        source = code.row_pointer(code.array_pointer("blocks"), code.integer("k"), 9)
        target = code.row_pointer(code.array_pointer("out"), builder.ashr(at, INDEX(1)), 9)
        eight, last = code.load(source, code.vector8), INDEX(8)
        code.store(code.order_by_parity(at, eight, code.transposed(eight))[0], target)
        builder.store(builder.load(builder.gep(source, [last])), builder.gep(target, [last]))

    return _without_result(write, blocks=blocks, k=k, out=out, at=at)


def _fetch(typing: Any, blocks: Any, k: Any) -> Any:
    """Prefetch block k into the caches; it need not exist."""

    def write(code: CodeBuilder) -> None:
        block = code.row_pointer(code.array_pointer("blocks"), code.integer("k"), 9)
        for last in (0, 8):  # a block may lie on two cache lines
            code.prefetch(code.builder.gep(block, [INDEX(last)]))

    return _without_result(write, blocks=blocks, k=k)


# callers leave out ``typing``
gather: Any = intrinsic(_gather)
gather_edges: Any = intrinsic(_gather_edges)
add_corners: Any = intrinsic(_add_corners)
add_outers: Any = intrinsic(_add_outers)
add_six: Any = intrinsic(_add_six)
add_triangle: Any = intrinsic(_add_triangle)
fetch: Any = intrinsic(_fetch)
store_block: Any = intrinsic(_store_block)
scatter: Any = intrinsic(_scatter)
scatter_edges: Any = intrinsic(_scatter_edges)
