"""Directors of edges, and the tangents T of the angles between directors and triangle normals.

A director d is a unit vector perpendicular to its edge, at the angle φ in a frame that follows the edge. The
frame is a reference director a₀ on an edge of direction t₀, parallel transported to the present direction t,
that is, by the smallest rotation (Bergou, Audoly, Vouga, Wardetzky & Grinspun, Discrete viscous threads,
SIGGRAPH 2010)::

    d = cos φ a + sin φ t × a,   a = P(t₀ → t) a₀

As the edge e = |e| t turns, d rotates about it at the rate φ̇ + γ · ė with γ = −t₀ × t / (|e| (1 + t₀ · t)).

In a triangle with unit normal n, counter-clockwise edges e_i = |e_i| t_i opposite its corners x_i and outward
normals m_i = t_i × n in its plane, α_i is the angle about t_i from n to the director of the edge::

    tan α_i = (d_i · m_i) / (d_i · n)

With an angle ᾱ_i in the rest shape the bending angle is α_i − ᾱ_i, which is written α_i in the following.
(With tan α_i − tan ᾱ_i triangles beside a crease of 90° would be four times too stiff.)

Up to 45° T(α) = S(α) = tan α. Beyond, T is extended linearly, ± (1 + 2 (|α| − π/4)) up to 180°, and S, in
which the edges of a triangle are coupled, returns to 0 at 180°. No mesh resolves folds of more than 90° at
one edge, and triangles that turn over, whose normal vanishes for a moment, must be able to pass their
directors.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import inlined, kernel, subkernel
from lyra_petsc.kernels.vector3 import cross, dot, minus, point, scaled

EXTENSION = 0.75 * math.pi
"""Angle from 45° to 180° [rad]."""

QUADRATIC, CUBIC = -(3.0 + 4.0 * EXTENSION) / EXTENSION**2, (2.0 + 2.0 * EXTENSION) / EXTENSION**3
"""Coefficients of S as a polynomial of the angle beyond 45°; S and its derivative vanish at 180°."""

BATCH = 16
"""Triangles that are computed together with SIMD instructions, except those that fade or have an angle beyond
45°. A batch stores each quantity of its triangles contiguously (structure of arrays): in arrays over the mesh
that are indexed by a stencil the compiler cannot prove that accesses do not alias."""

SMALLEST_COSINE = -0.8
"""Smallest cosine of the angle between an edge and its frame: at −1 parallel transport is undefined."""


_numbers = itertools.count()


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames of n edges, in which the angles of their directors are measured.

    Attributes
    ----------
    direction, reference : (n, 3)
        Unit vectors t₀ along the edges, and reference directors a₀.
    number : int
        Another one for each set of frames.
    """

    direction: Array
    reference: Array
    number: int = field(default_factory=lambda: next(_numbers), init=False)

    @property
    def vectors(self) -> tuple[Array, Array]:
        """Direction and reference."""
        return self.direction, self.reference


def unit(vectors: Array) -> Array:
    """Normalised vectors (n, 3); NaN for vectors of length 0."""
    with np.errstate(invalid="ignore", divide="ignore"):
        normalised: Array = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return normalised


def some_perpendicular(direction: Array) -> Array:
    """Unit vectors (n, 3) perpendicular to unit vectors ``direction`` (n, 3), on which alone they depend."""
    axis = np.eye(3)[np.argmin(np.abs(direction), axis=1)]
    return unit(axis - np.sum(axis * direction, axis=1, keepdims=True) * direction)


@kernel()
def directions(x, ends, out):  # type: ignore[no-untyped-def]
    """Write unit vectors along edges (n, 2) into out (n, 3); NaN for edges of length 0."""
    for k in range(ends.shape[0]):
        e = minus(point(x, ends[k, 1]), point(x, ends[k, 0]))
        out[k, 0], out[k, 1], out[k, 2] = scaled(1.0 / math.sqrt(dot(e, e)), e)


@kernel()
def mark_turned_edges(x, ends, direction, out):  # type: ignore[no-untyped-def]
    """Mark in out (n,) the edges (n, 2) at more than 90° to ``direction`` (n, 3); return whether any is."""
    any_turned = False
    for k in range(ends.shape[0]):
        e = minus(point(x, ends[k, 1]), point(x, ends[k, 0]))
        out[k] = dot(e, (direction[k, 0], direction[k, 1], direction[k, 2])) < 0.0
        any_turned |= out[k]
    return any_turned


@kernel()
def largest_angle(unknowns, indices, length):  # type: ignore[no-untyped-def]
    """Largest angle [rad] of the edge unknowns (m,) [m] at ascending ``indices`` (n,), up to m."""
    largest = 0.0
    for k in range(len(indices)):
        if indices[k] >= len(unknowns):
            break
        angle = abs(unknowns[indices[k]]) / length[k]
        largest = angle if angle > largest or angle != angle else largest
    return largest


@kernel()
def transport(start, reference, end, out):  # type: ignore[no-untyped-def]
    """Write reference directors (n, 3), transported from edge directions ``start`` to ``end``, into out."""
    for k in range(len(out)):
        t = end[k, 0], end[k, 1], end[k, 2]
        t0 = start[k, 0], start[k, 1], start[k, 2]
        a = _parallel_transport(t0, (reference[k, 0], reference[k, 1], reference[k, 2]), t)
        # orthonormalised, since round-off would accumulate over the steps
        along = dot(a, t)
        a = a[0] - along * t[0], a[1] - along * t[1], a[2] - along * t[2]
        out[k, 0], out[k, 1], out[k, 2] = scaled(1.0 / math.sqrt(dot(a, a)), a)


def transported(frames: Frames, direction: Array) -> Array:
    """Reference directors a (n, 3), parallel transported to edges of ``direction`` (n, 3)."""
    out = np.empty_like(direction)
    transport(*frames.vectors, direction, out)
    return out


@inlined()
def _parallel_transport(t0, a0, t):  # type: ignore[no-untyped-def]
    """The vector a₀ parallel transported from t₀ to t."""
    c, b = dot(t0, t), cross(t0, t)
    ba, along = cross(b, a0), dot(b, a0) / (1.0 + c)
    return (
        c * a0[0] + ba[0] + along * b[0],
        c * a0[1] + ba[1] + along * b[1],
        c * a0[2] + ba[2] + along * b[2],
    )


@kernel()
def directors(x, ends, direction, reference, cosine, sine, out):  # type: ignore[no-untyped-def]
    """Write the directors d of edges (n, 2) into out (n, 3); 0 where an edge is too far from its frame."""
    for k in range(ends.shape[0]):
        e = minus(point(x, ends[k, 1]), point(x, ends[k, 0]))
        t = scaled(1.0 / math.sqrt(dot(e, e)), e)
        t0 = direction[k, 0], direction[k, 1], direction[k, 2]
        a0 = reference[k, 0], reference[k, 1], reference[k, 2]
        if not dot(t0, t) > SMALLEST_COSINE:
            out[k, :] = 0.0
            continue
        a = _parallel_transport(t0, a0, t)
        w = cross(t, a)
        for i in range(3):
            out[k, i] = cosine[k] * a[i] + sine[k] * w[i]


@inlined()
def spin(t0, e):  # type: ignore[no-untyped-def]
    """The vector γ [1/m] of an edge e [m] with the frame direction t₀.

    Its derivative by e is −γ ρᵀ with ρ = 2 t / |e| + γ × t, plus an antisymmetric part.
    """
    square = dot(e, e)
    return scaled(-1.0 / (square + math.sqrt(square) * dot(t0, e)), cross(t0, e))


@inlined()
def vector_at(values, k, first):  # type: ignore[no-untyped-def]
    """Three values of row k, from column ``first``."""
    k = Index(k)
    return values[k, first], values[k, first + 1], values[k, first + 2]


@inlined()
def edges_and_normal(x0, x1, x2):  # type: ignore[no-untyped-def]
    """Edges e_i of a triangle, its normal N = 2A n and |N|²."""
    e0, e1, e2 = minus(x2, x1), minus(x0, x2), minus(x1, x0)
    normal = cross(e1, e2)
    return e0, e1, e2, normal, dot(normal, normal)


@inlined()
def tangent_of(d, e, normal):  # type: ignore[no-untyped-def]
    """T of the angle about edge e from the normal N of a triangle to a director d; NaN if undefined."""
    height, side = _height_and_side(d, e, normal)
    if abs(side) < height:
        return side / height
    return _extended_tangent(side, height)


@inlined()
def _height_and_side(d, e, normal):  # type: ignore[no-untyped-def]
    """Components of a director d along the normal N and in the triangle's plane, both times |N|."""
    return dot(d, normal), dot(d, cross(e, normal)) / math.sqrt(dot(e, e))


@subkernel()
def _extended_tangent(side, height):  # type: ignore[no-untyped-def]
    """T of an angle beyond 45°."""
    if side == 0.0 and height == 0.0:
        return np.nan
    return math.copysign(1.0 + 2.0 * (math.atan2(abs(side), height) - 0.25 * math.pi), side)


@inlined()
def derivatives(t):  # type: ignore[no-untyped-def]
    """T', T'', S, S' and S'' at the angle with T = t."""
    if abs(t) < 1.0:
        return derivatives_below_45(t)
    return _extended_derivatives(t)


@inlined()
def derivatives_below_45(t):  # type: ignore[no-untyped-def]
    """T', T'', S, S' and S'' at the angle with T = t, up to 45°."""
    slope = 1.0 + t * t
    bend = 2.0 * t * slope
    return slope, bend, t, slope, bend


@subkernel()
def _extended_derivatives(t):  # type: ignore[no-untyped-def]
    """T', T'', S, S' and S'' at the angle with T = t, beyond 45°."""
    x = 0.5 * (abs(t) - 1.0)
    slope, bend = 2.0 + x * (2.0 * QUADRATIC + x * 3.0 * CUBIC), 2.0 * QUADRATIC + 6.0 * CUBIC * x
    return 2.0, 0.0, math.copysign(_coupling_polynomial(x), t), slope, math.copysign(1.0, t) * bend


@inlined()
def _coupling_polynomial(x):  # type: ignore[no-untyped-def]
    """S at an angle x [rad] beyond 45°."""
    return 1.0 + x * (2.0 + x * (QUADRATIC + x * CUBIC))


@inlined()
def coupling_tangent(t):  # type: ignore[no-untyped-def]
    """S at the angle with T = t."""
    if abs(t) < 1.0:
        return t
    return math.copysign(_coupling_polynomial(0.5 * (abs(t) - 1.0)), t)


def tangents_at(angle: Array) -> Array:
    """T of angles α [rad], an array of any shape."""
    size = np.abs(angle)
    beyond = 1.0 + 2.0 * (size - 0.25 * np.pi)
    return np.copysign(np.where(size < 0.25 * np.pi, np.tan(size), beyond), angle)


@kernel(inline="always")
def store(batch, row, i, values):  # type: ignore[no-untyped-def]
    """Store three values of triangle i in rows ``row``, row + 1, row + 2 of a batch."""
    batch[Index(BATCH * row) + i] = values[0]
    batch[Index(BATCH * row + BATCH) + i] = values[1]
    batch[Index(BATCH * row + 2 * BATCH) + i] = values[2]


@kernel(inline="always")
def load(batch, row, i):  # type: ignore[no-untyped-def]
    """Three values of triangle i in rows ``row``, row + 1, row + 2 of a batch."""
    return (
        batch[Index(BATCH * row) + i],
        batch[Index(BATCH * row + BATCH) + i],
        batch[Index(BATCH * row + 2 * BATCH) + i],
    )


@subkernel()
def load_edges(x, stencil, first, batch):  # type: ignore[no-untyped-def]
    """Store the edges e_i of triangles from ``first`` on in rows 0 to 8 of a batch.

    A batch that is not full repeats the last triangle.
    """
    last = stencil.shape[0] - 1
    for number in range(BATCH):
        e, i = min(first + number, last), Index(number)
        x0, x1, x2 = point(x, stencil[e, 0]), point(x, stencil[e, 1]), point(x, stencil[e, 2])
        store(batch, 0, i, minus(x2, x1))
        store(batch, 3, i, minus(x0, x2))
        store(batch, 6, i, minus(x1, x0))


@inlined()
def _without_rest_angle(director, edges, rest_rotation, e, i, edge):  # type: ignore[no-untyped-def]
    """The director of edge i of triangle e, rotated about the edge by −ᾱ."""
    d = vector_at(director, edges[e, i], 0)
    if rest_rotation.shape[0] == 0:
        return d
    side, c, s = cross(edge, d), rest_rotation[e, i, 0], -rest_rotation[e, i, 1] / math.sqrt(dot(edge, edge))
    return c * d[0] + s * side[0], c * d[1] + s * side[1], c * d[2] + s * side[2]


@subkernel()
def _load_directors(edges, director, rest_rotation, first, batch):  # type: ignore[no-untyped-def]
    """Store the directors of the edges in rows 0 to 8 of a batch in rows 9 to 17."""
    last = edges.shape[0] - 1
    for number in range(BATCH):
        e, i = min(first + number, last), Index(number)
        store(batch, 9, i, _without_rest_angle(director, edges, rest_rotation, e, 0, load(batch, 0, i)))
        store(batch, 12, i, _without_rest_angle(director, edges, rest_rotation, e, 1, load(batch, 3, i)))
        store(batch, 15, i, _without_rest_angle(director, edges, rest_rotation, e, 2, load(batch, 6, i)))


@inlined()
def _tangent_below_45(d, e, normal):  # type: ignore[no-untyped-def]
    """T of an angle up to 45°, 2 beyond."""
    height, side = _height_and_side(d, e, normal)
    return side / height if abs(side) < height else 2.0


@kernel()
def _compute_tangents(batch):  # type: ignore[no-untyped-def]
    """Store T, or 2 for angles beyond 45°, in rows 18 to 20 of a batch and |N|² in row 21."""
    for number in range(BATCH):
        i = Index(number)
        e0, e1, e2 = load(batch, 0, i), load(batch, 3, i), load(batch, 6, i)
        normal = cross(e1, e2)
        one = _tangent_below_45(load(batch, 9, i), e0, normal)
        two = _tangent_below_45(load(batch, 12, i), e1, normal)
        three = _tangent_below_45(load(batch, 15, i), e2, normal)
        store(batch, 18, i, (one, two, three))
        batch[Index(BATCH * 21) + i] = dot(normal, normal)


@kernel()
def tangents(x, stencil, edges, director, rest_rotation, out):  # type: ignore[no-untyped-def]
    """Write the three T of triangles (E, 3) and |N|² into out (E, 4).

    The angles are those of directors (n_edges, 3) less ᾱ_i; ``rest_rotation`` (E, 3, 2) holds cos ᾱ and
    sin ᾱ, and is empty for sheets that are flat at rest.
    """
    batch = np.empty(22 * BATCH)
    for e in range(out.shape[0]):
        i = Index(e % BATCH)
        if i == 0:
            load_edges(x, stencil, e, batch)
            _load_directors(edges, director, rest_rotation, e, batch)
            _compute_tangents(batch)
        t0, t1, t2 = load(batch, 18, i)
        if not max(t0, t1, t2) < 2.0:
            e0, e1, e2 = load(batch, 0, i), load(batch, 3, i), load(batch, 6, i)
            normal = cross(e1, e2)
            t0 = tangent_of(load(batch, 9, i), e0, normal)
            t1 = tangent_of(load(batch, 12, i), e1, normal)
            t2 = tangent_of(load(batch, 15, i), e2, normal)
        out[e, 0], out[e, 1], out[e, 2], out[e, 3] = t0, t1, t2, batch[Index(BATCH * 21) + i]
