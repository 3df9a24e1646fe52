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
def _carry(tangent, across, present, out):  # type: ignore[no-untyped-def]
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
    _carry(*frames, tangent, out)
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
    """Of edges (n, 2): director d and γ [1/m], into out (n, 6).

    γ changes with the edge by −γ ρᵀ, ρ = 2 t / |e| + γ × t, and an antisymmetric part. d is 0 where an edge
    is too far from its frame.
    """
    for k in range(ends.shape[0]):
        e = minus(point(x, ends[k, 1]), point(x, ends[k, 0]))
        length = math.sqrt(dot(e, e))
        t = scaled(1.0 / length, e)
        t0 = tangent[k, 0], tangent[k, 1], tangent[k, 2]
        a0 = across[k, 0], across[k, 1], across[k, 2]
        c, b = dot(t0, t), cross(t0, t)
        if not c > FARTHEST:
            out[k, :] = 0.0
            continue
        a = _turned(t0, a0, t)
        w = cross(t, a)
        inverse = 1.0 / (length * (1.0 + c))
        for i in range(3):
            out[k, i] = cosine[k] * a[i] + sine[k] * w[i]
            out[k, 3 + i] = -inverse * b[i]


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
def turned_back(shape, edges, tilt, e, i, edge):  # type: ignore[no-untyped-def]
    """The director of edge i of triangle e, turned about the edge by −ᾱ."""
    d = row(shape, edges[e, i], 0)
    if tilt.shape[0] == 0:
        return d
    side, c, s = cross(edge, d), tilt[e, i, 0], -tilt[e, i, 1] / math.sqrt(dot(edge, edge))
    return c * d[0] + s * side[0], c * d[1] + s * side[1], c * d[2] + s * side[2]


@kernel(inline="always")
def tangent_of(d, e, normal):  # type: ignore[no-untyped-def]
    """T, T', T'', S, S', S'' at α of a director on an edge of a triangle with this normal N."""
    height, side = dot(d, normal), dot(d, cross(e, normal)) / math.sqrt(dot(e, e))
    if abs(side) < height:
        t = side / height
        slope = 1.0 + t * t
        bend = 2.0 * t * slope
        return t, slope, bend, t, slope, bend
    return _beyond(side, height)


@kernel()
def _beyond(side, height):  # type: ignore[no-untyped-def]
    """The same beyond 45°; NaN without a director or a normal."""
    if side == 0.0 and height == 0.0:
        return np.nan, np.nan, np.nan, np.nan, np.nan, np.nan
    sign = math.copysign(1.0, side)
    x = math.atan2(abs(side), height) - 0.25 * math.pi
    slope, bend = 2.0 + x * (2.0 * QUADRATIC + x * 3.0 * CUBIC), 2.0 * QUADRATIC + 6.0 * CUBIC * x
    return sign * (1.0 + 2.0 * x), 2.0, 0.0, sign * _fading(x), slope, sign * bend


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


@kernel()
def tangents(x, stencil, edges, shape, tilt, out):  # type: ignore[no-untyped-def]
    """T of triangles (E, 3) into out (E, 3), of α_i − ᾱ_i by ``tilt`` (E, 3, 2), cos ᾱ and sin ᾱ.

    It may be empty, as those of sheets that are flat at rest.
    """
    for e in range(stencil.shape[0]):
        x0, x1, x2 = point(x, stencil[e, 0]), point(x, stencil[e, 1]), point(x, stencil[e, 2])
        e0, e1, e2, normal, _ = edges_of(x0, x1, x2)
        out[e, 0] = tangent_of(turned_back(shape, edges, tilt, e, 0, e0), e0, normal)[0]
        out[e, 1] = tangent_of(turned_back(shape, edges, tilt, e, 1, e1), e1, normal)[0]
        out[e, 2] = tangent_of(turned_back(shape, edges, tilt, e, 2, e2), e2, normal)[0]
