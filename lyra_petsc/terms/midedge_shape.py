"""Directors of edges, and the tangents T of the angles that they have with the normals of their triangles.

A director d is a unit vector perpendicular to its edge, at the angle φ in a frame that follows the edge: the
direction a₀ that it had on an edge of direction t₀, carried by the smallest rotation to the present direction
t (Bergou, Audoly, Vouga, Wardetzky & Grinspun, Discrete viscous threads, SIGGRAPH 2010)::

    d = cos φ a + sin φ t × a,   a = P(t₀ → t) a₀

As the edge e = |e| t turns, d spins about it at the rate φ̇ + γ · ė with γ = −t₀ × t / (|e| (1 + t₀ · t)).

In a triangle with unit normal n, counter-clockwise edges e_i = |e_i| t_i opposite its corners x_i and outward
normals m_i = t_i × n in its plane, α_i is the angle about t_i from n to the director of the edge::

    tan α_i = (d_i · m_i) / (d_i · n)

Where the rest shape has an angle ᾱ_i, what bends is α_i − ᾱ_i, which stands for α_i in all that follows: by
tan α_i − tan ᾱ_i the triangles beside a crease of 90° would be four times too stiff.

Up to 45° T(α) = S(α) = tan α. Beyond, T goes on along its tangent, ± (1 + 2 (|α| − π/4)) to 180°, and S,
which couples the edges, returns to 0 there: no mesh resolves folds of more than 90° at one edge, and
triangles that turn over, which lose their normal for a moment, must be able to pass their directors.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import kernel
from lyra_petsc.terms.hinge import cross, dot, minus, point, scaled

LEFT = 0.75 * math.pi
"""Angle from 45° to 180° [rad]."""

QUADRATIC, CUBIC = -(3.0 + 4.0 * LEFT) / LEFT**2, (2.0 + 2.0 * LEFT) / LEFT**3
"""Of S as a polynomial of the angle beyond 45°, which ends at 180° with its derivative."""

BATCH = 16
"""Triangles that are computed together, several at a time where the processor can, but for those that fade or
have an angle beyond 45°. Number i of each stands in a row of its own, so that a compiler sees what it may do
at once: in arrays of elements, looked up by numbers of points, it cannot know that they do not overlap."""

FARTHEST = -0.8
"""Cosine of the angle by which an edge may turn from its frame: at −1 there is no smallest rotation."""


class Frames(NamedTuple):
    """What directors of n edges are measured in.

    Attributes
    ----------
    tangent, across : (n, 3)
        t₀ and a₀, unit vectors.
    """

    tangent: Array
    across: Array


def unit(vectors: Array) -> Array:
    """Vectors (n, 3) made 1 long; NaN where they have no direction."""
    with np.errstate(invalid="ignore", divide="ignore"):
        made: Array = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return made


def some_perpendicular(tangent: Array) -> Array:
    """Unit vectors (n, 3) perpendicular to others, by a rule that knows nothing but these."""
    axis = np.eye(3)[np.argmin(np.abs(tangent), axis=1)]
    return unit(axis - np.sum(axis * tangent, axis=1, keepdims=True) * tangent)


@kernel()
def directions(x, ends, out):  # type: ignore[no-untyped-def]
    """Unit vectors along edges (n, 2), into out (n, 3); NaN of those without a length."""
    for k in range(ends.shape[0]):
        e = minus(point(x, ends[k, 1]), point(x, ends[k, 0]))
        out[k, 0], out[k, 1], out[k, 2] = scaled(1.0 / math.sqrt(dot(e, e)), e)


@kernel()
def against(x, ends, tangent, out):  # type: ignore[no-untyped-def]
    """Into out (n,) which edges (n, 2) are over a right angle from ``tangent`` (n, 3); whether any is."""
    found = False
    for k in range(ends.shape[0]):
        e = minus(point(x, ends[k, 1]), point(x, ends[k, 0]))
        out[k] = dot(e, (tangent[k, 0], tangent[k, 1], tangent[k, 2])) < 0.0
        found |= out[k]
    return found


@kernel()
def largest_angle(unknowns, places, length):  # type: ignore[no-untyped-def]
    """Largest angle [rad] that unknowns (m,) of edges are, whose places (n,) ascend; of places up to m."""
    most = 0.0
    for k in range(len(places)):
        if places[k] >= len(unknowns):
            break
        angle = abs(unknowns[places[k]]) / length[k]
        most = angle if angle > most or angle != angle else most
    return most


@kernel()
def carry(tangent, across, present, out):  # type: ignore[no-untyped-def]
    """As ``carried``, into out (n, 3)."""
    for k in range(len(out)):
        t = present[k, 0], present[k, 1], present[k, 2]
        t0 = tangent[k, 0], tangent[k, 1], tangent[k, 2]
        a = _turned(t0, (across[k, 0], across[k, 1], across[k, 2]), t)
        # rounding must not gather over the steps
        along = dot(a, t)
        a = a[0] - along * t[0], a[1] - along * t[1], a[2] - along * t[2]
        out[k, 0], out[k, 1], out[k, 2] = scaled(1.0 / math.sqrt(dot(a, a)), a)


def carried(frames: Frames, tangent: Array) -> Array:
    """a (n, 3): a₀ as the smallest rotation carries it to edges of direction ``tangent`` (n, 3)."""
    out = np.empty_like(tangent)
    carry(*frames, tangent, out)
    return out


@kernel(inline="always")
def _turned(t0, a0, t):  # type: ignore[no-untyped-def]
    """a₀ carried from t₀ to t."""
    c, b = dot(t0, t), cross(t0, t)
    ba, along = cross(b, a0), dot(b, a0) / (1.0 + c)
    return (
        c * a0[0] + ba[0] + along * b[0],
        c * a0[1] + ba[1] + along * b[1],
        c * a0[2] + ba[2] + along * b[2],
    )


@kernel()
def directors(x, ends, tangent, across, cosine, sine, out):  # type: ignore[no-untyped-def]
    """Directors d of edges (n, 2) into out (n, 3); 0 where an edge is too far from its frame."""
    for k in range(ends.shape[0]):
        e = minus(point(x, ends[k, 1]), point(x, ends[k, 0]))
        t = scaled(1.0 / math.sqrt(dot(e, e)), e)
        t0 = tangent[k, 0], tangent[k, 1], tangent[k, 2]
        a0 = across[k, 0], across[k, 1], across[k, 2]
        if not dot(t0, t) > FARTHEST:
            out[k, :] = 0.0
            continue
        a = _turned(t0, a0, t)
        w = cross(t, a)
        for i in range(3):
            out[k, i] = cosine[k] * a[i] + sine[k] * w[i]


@kernel(inline="always")
def spin(t0, e):  # type: ignore[no-untyped-def]
    """γ [1/m] of an edge e [m] whose frame is of direction t₀.

    It changes with the edge by −γ ρᵀ, ρ = 2 t / |e| + γ × t, and an antisymmetric part.
    """
    square = dot(e, e)
    return scaled(-1.0 / (square + math.sqrt(square) * dot(t0, e)), cross(t0, e))


@kernel(inline="always")
def row(values, k, first):  # type: ignore[no-untyped-def]
    """Three numbers of row k from a column on."""
    k = Index(k)
    return values[k, first], values[k, first + 1], values[k, first + 2]


@kernel(inline="always")
def edges_of(x0, x1, x2):  # type: ignore[no-untyped-def]
    """Edges e_i of a triangle, its normal N = 2A n, and |N|²."""
    e0, e1, e2 = minus(x2, x1), minus(x0, x2), minus(x1, x0)
    normal = cross(e1, e2)
    return e0, e1, e2, normal, dot(normal, normal)


@kernel(inline="always")
def tangent_of(d, e, normal):  # type: ignore[no-untyped-def]
    """T at α of a director on an edge of a triangle with this normal N; NaN without one of them."""
    height, side = _height_and_side(d, e, normal)
    if abs(side) < height:
        return side / height
    return _beyond(side, height)


@kernel(inline="always")
def _height_and_side(d, e, normal):  # type: ignore[no-untyped-def]
    return dot(d, normal), dot(d, cross(e, normal)) / math.sqrt(dot(e, e))


@kernel()
def _beyond(side, height):  # type: ignore[no-untyped-def]
    """T beyond 45°."""
    if side == 0.0 and height == 0.0:
        return np.nan
    return math.copysign(1.0 + 2.0 * (math.atan2(abs(side), height) - 0.25 * math.pi), side)


@kernel(inline="always")
def derivatives(t):  # type: ignore[no-untyped-def]
    """T', T'', S, S', S'' at the angle at which T is t."""
    if abs(t) < 1.0:
        return plain_derivatives(t)
    return _derivatives_beyond(t)


@kernel(inline="always")
def plain_derivatives(t):  # type: ignore[no-untyped-def]
    """The same up to 45°."""
    slope = 1.0 + t * t
    bend = 2.0 * t * slope
    return slope, bend, t, slope, bend


@kernel()
def _derivatives_beyond(t):  # type: ignore[no-untyped-def]
    x = 0.5 * (abs(t) - 1.0)
    slope, bend = 2.0 + x * (2.0 * QUADRATIC + x * 3.0 * CUBIC), 2.0 * QUADRATIC + 6.0 * CUBIC * x
    return 2.0, 0.0, math.copysign(_fading(x), t), slope, math.copysign(1.0, t) * bend


@kernel(inline="always")
def _fading(x):  # type: ignore[no-untyped-def]
    """S at the angle x beyond 45°."""
    return 1.0 + x * (2.0 + x * (QUADRATIC + x * CUBIC))


@kernel(inline="always")
def fading_tangent(t):  # type: ignore[no-untyped-def]
    """S at the angle at which T is t."""
    if abs(t) < 1.0:
        return t
    return math.copysign(_fading(0.5 * (abs(t) - 1.0)), t)


def tangents_at(angle: Array) -> Array:
    """T of angles α [rad], of any shape."""
    size = np.abs(angle)
    beyond = 1.0 + 2.0 * (size - 0.25 * np.pi)
    return np.copysign(np.where(size < 0.25 * np.pi, np.tan(size), beyond), angle)


@kernel(inline="always")
def put(batch, at, i, numbers):  # type: ignore[no-untyped-def]
    """Rows from ``at`` on of triangle i of a batch become three numbers."""
    batch[Index(BATCH * at) + i] = numbers[0]
    batch[Index(BATCH * at + BATCH) + i] = numbers[1]
    batch[Index(BATCH * at + 2 * BATCH) + i] = numbers[2]


@kernel(inline="always")
def got(batch, at, i):  # type: ignore[no-untyped-def]
    """Three numbers of triangle i of a batch, in rows from ``at`` on."""
    return (
        batch[Index(BATCH * at) + i],
        batch[Index(BATCH * at + BATCH) + i],
        batch[Index(BATCH * at + 2 * BATCH) + i],
    )


@kernel()
def load_edges(x, stencil, first, batch):  # type: ignore[no-untyped-def]
    """Into rows 0 to 8 of a batch e_i of triangles from ``first`` on; the last fills it."""
    last = stencil.shape[0] - 1
    for number in range(BATCH):
        e, i = min(first + number, last), Index(number)
        x0, x1, x2 = point(x, stencil[e, 0]), point(x, stencil[e, 1]), point(x, stencil[e, 2])
        put(batch, 0, i, minus(x2, x1))
        put(batch, 3, i, minus(x0, x2))
        put(batch, 6, i, minus(x1, x0))


@kernel(inline="always")
def _turned_back(director, edges, tilt, e, i, edge):  # type: ignore[no-untyped-def]
    """The director of edge i of triangle e, turned about the edge by −ᾱ."""
    d = row(director, edges[e, i], 0)
    if tilt.shape[0] == 0:
        return d
    side, c, s = cross(edge, d), tilt[e, i, 0], -tilt[e, i, 1] / math.sqrt(dot(edge, edge))
    return c * d[0] + s * side[0], c * d[1] + s * side[1], c * d[2] + s * side[2]


@kernel()
def _load_directors(edges, director, tilt, first, batch):  # type: ignore[no-untyped-def]
    """Into rows 9 to 17 of a batch the directors of the edges in rows 0 to 8."""
    last = edges.shape[0] - 1
    for number in range(BATCH):
        e, i = min(first + number, last), Index(number)
        put(batch, 9, i, _turned_back(director, edges, tilt, e, 0, got(batch, 0, i)))
        put(batch, 12, i, _turned_back(director, edges, tilt, e, 1, got(batch, 3, i)))
        put(batch, 15, i, _turned_back(director, edges, tilt, e, 2, got(batch, 6, i)))


@kernel(inline="always")
def _plain_tangent(d, e, normal):  # type: ignore[no-untyped-def]
    """T up to 45°, else 2."""
    height, side = _height_and_side(d, e, normal)
    return side / height if abs(side) < height else 2.0


@kernel()
def _compute_tangents(batch):  # type: ignore[no-untyped-def]
    """Into rows 18 to 20 of a batch T, or 2 beyond 45°, and into row 21 |N|²."""
    for number in range(BATCH):
        i = Index(number)
        e0, e1, e2 = got(batch, 0, i), got(batch, 3, i), got(batch, 6, i)
        normal = cross(e1, e2)
        one = _plain_tangent(got(batch, 9, i), e0, normal)
        two = _plain_tangent(got(batch, 12, i), e1, normal)
        three = _plain_tangent(got(batch, 15, i), e2, normal)
        put(batch, 18, i, (one, two, three))
        batch[Index(BATCH * 21) + i] = dot(normal, normal)


@kernel()
def tangents(x, stencil, edges, director, tilt, out):  # type: ignore[no-untyped-def]
    """T of triangles (E, 3) and |N|² into out (E, 4), of the angles α_i of directors (n_edges, 3) less ᾱ_i,
    by ``tilt`` (E, 3, 2), cos ᾱ and sin ᾱ.

    It may be empty, as those of sheets that are flat at rest.
    """
    batch = np.empty(22 * BATCH)
    for e in range(out.shape[0]):
        i = Index(e % BATCH)
        if i == 0:
            load_edges(x, stencil, e, batch)
            _load_directors(edges, director, tilt, e, batch)
            _compute_tangents(batch)
        t0, t1, t2 = got(batch, 18, i)
        if not max(t0, t1, t2) < 2.0:
            e0, e1, e2 = got(batch, 0, i), got(batch, 3, i), got(batch, 6, i)
            normal = cross(e1, e2)
            t0 = tangent_of(got(batch, 9, i), e0, normal)
            t1 = tangent_of(got(batch, 12, i), e1, normal)
            t2 = tangent_of(got(batch, 15, i), e2, normal)
        out[e, 0], out[e, 1], out[e, 2], out[e, 3] = t0, t1, t2, batch[Index(BATCH * 21) + i]
