"""One-sided springs with the barrier's force on distances that are linear in a Newton increment.

A spring has the length δ = δ_0 + Σ_i β_i n · w_i for increments w_i of its four points, and pushes with the
barrier's force at δ. Points of obstacles, whose numbers are negative, do not move.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.contact.barrier_law import barrier, distance_of_force, is_mollified
from lyra_petsc.contact.pair_distances import (
    EDGE_EDGE,
    VERTEX_INSIDE,
    box_distance,
    load_points,
    signed_distance,
)
from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import kernel
from lyra_petsc.kernels.vector3 import scaled
from lyra_petsc.kernels.vectors import add_outers
from lyra_petsc.terms.term import Offsets

TANGENT_BELOW = 0.5
"""Part of the gap, or of the present distance if that is less, below which the law is continued by its
tangent, so that linear systems are not stiffer than the sheet. The barrier's distances follow afterwards from
the expected forces (`pair_motion.target_distances`)."""


MIN_CHORD = 1e-3
"""Length of a chord over the gap below which it is replaced by the tangent."""


class Springs(NamedTuple):
    """Springs of one term.

    Attributes
    ----------
    pair : (m,) int64
        Numbers of the term's elements; one may occur several times.
    points : (m, 4) int64
        Local rows, or points of obstacles (negative).
    beta, normal : (m, 4), (m, 3)
        β and unit normals n.
    scale, gap, length : (m,)
        Weight times the barrier's k [N/m], gap [m] and distance less offset δ_0 [m].
    counted : (m,)
        Weight on this rank over the weight.
    acts : (m,) bool
        Whether the pair is already part of the term's gradient and Hessian.
    """

    pair: NDArray[np.int64]
    points: NDArray[np.int64]
    beta: Array
    normal: Array
    scale: Array
    gap: Array
    length: Array
    counted: Array
    acts: NDArray[np.bool_]

    def elongations(self, increment: Array) -> Array:
        """Changes of length (m,) [m] for an increment (n_local, 3) [m]."""
        out = np.empty(len(self.pair))
        _elongations(self.points, self.beta, self.normal, increment, out)
        return out

    @property
    def _lower_bound(self) -> Array:
        """Lengths (m,) [m] below which the law is continued by its tangent."""
        return TANGENT_BELOW * np.minimum(self.gap, self.length)

    def law(self, length: Array) -> tuple[Array, Array]:
        """Forces (m,) [N] and stiffness (m,) [N/m] at lengths (m,) [m]."""
        force, stiffness = np.empty((2, len(self.pair)))
        spring_forces(length, self.gap, self._lower_bound, force, stiffness)
        return self.scale * force, self.scale * stiffness

    def secant_stiffness(self, length: Array, force: Array, expected: Array) -> Array:
        """Slopes (m,) [N/m] of the law from ``force`` (m,) [N] at ``length`` (m,) [m] to the ``expected``
        force (m,) [N].
        """
        out, bound, forces = np.empty(len(self.pair)), self._lower_bound, (force, expected)
        secant_stiffness(length, self.gap, bound, *(f / self.scale for f in forces), out)
        return self.scale * out

    def add_forces(self, size: Array, out: Array) -> None:
        """Add ``size`` (m,) [N] times the gradients of the lengths to rows of out (n_local, 3)."""
        _add_forces(self.points, self.beta, self.normal, size, out)

    def add_stiffness(self, stiffness: Array, offsets: Offsets, values: Array) -> None:
        """Add Hessians of two-sided springs of a ``stiffness`` (m,) [N/m] to block rows (n_blocks, 3, 3).

        ``offsets`` (E, 10) are those of the term's elements.
        """
        _add_stiffness(self.pair, self.points, self.beta, self.normal, stiffness, offsets, values)


@kernel()
def _elongations(points, beta, normal, increment, out):  # type: ignore[no-untyped-def]
    for m in range(len(out)):
        out[m] = 0.0
        for i in range(4):
            if points[m, i] >= 0:
                for k in range(3):
                    out[m] += beta[m, i] * normal[m, k] * increment[Index(points[m, i]), k]


@kernel()
def _add_forces(points, beta, normal, size, out):  # type: ignore[no-untyped-def]
    for m in range(len(size)):
        for i in range(4):
            if points[m, i] >= 0:
                for k in range(3):
                    out[Index(points[m, i]), k] += size[m] * beta[m, i] * normal[m, k]


@kernel()
def _add_stiffness(pair, points, beta, normal, stiffness, offsets, values):  # type: ignore[no-untyped-def]
    blocks = values.reshape(-1, 9)
    for m in range(len(pair)):
        n = normal[m, 0], normal[m, 1], normal[m, 2]
        for a in range(4):
            for b in range(a, 4):
                factor, block = stiffness[m] * beta[m, a] * beta[m, b], offsets[pair[m], (7 - a) * a // 2 + b]
                if factor != 0.0 and points[m, a] >= 0 and points[m, b] >= 0 and block >= 0:
                    add_outers(blocks, block, 0.0, ((scaled(factor, n), n),))


@kernel()
def find_springs(  # type: ignore[no-untyped-def]
    x, x_obs, approach, kind, points, offset, gap, stiffness, parallel, active, n_counted, out
):  # fmt: skip
    """Find one-sided springs, whose length is linear in a step: of active pairs, and of pairs that an
    ``approach`` [m] of their points may activate.

    Parameters
    ----------
    active : tuple
        Numbers, weights, weights on this rank, β and derivatives of the pairs from `find_active`.
    out : tuple of (capacity,), (capacity, 4), (capacity, 3), (capacity,), (capacity,), (capacity,)
        Output: numbers of the pairs, β, unit normals, weight times k [N/m], δ at x [m], and the weight on
        this rank over the weight.

    Returns
    -------
    n_active, n : int
        Number of springs of active pairs, which come first, and of all; only the first ``capacity`` are
        written.
    """
    numbers, beta, normal, spring, length, counted = out
    pair, weight, owned_weight, active_beta, derivatives = active
    p, u, b, no_side, n = np.empty((4, 3)), np.empty(3), np.empty(4), np.zeros(3), 0
    for m in range(len(pair)):
        e = pair[m]
        if not weight[m] > 0.0 or not derivatives[m, 4] > 0.0 or not derivatives[m, 4] < np.inf:
            continue
        if kind[e] == EDGE_EDGE:
            load_points(x, x_obs, points, e, p)
            if is_mollified(p, parallel):
                continue
        d = math.sqrt(derivatives[m, 0] ** 2 + derivatives[m, 1] ** 2 + derivatives[m, 2] ** 2)
        d = -d if kind[e] == VERTEX_INSIDE else d
        numbers[n], spring[n], counted[n] = e, weight[m] * stiffness[e], owned_weight[m] / weight[m]
        length[n] = d - offset[e]
        for i in range(4):
            beta[n, i] = active_beta[m, i]
        for k in range(3):
            normal[n, k] = derivatives[m, k] / d
        n += 1
    n_active = n
    for e in range(len(kind)):
        load_points(x, x_obs, points, e, p)
        if box_distance(p, kind[e]) - offset[e] - approach >= gap[e]:
            continue
        delta = signed_distance(p, kind[e], no_side, b, u) - offset[e]
        # nearer pairs are active, by themselves or by a pair with the same nearest points
        if not gap[e] <= delta < gap[e] + approach or (kind[e] == EDGE_EDGE and is_mollified(p, parallel)):
            continue
        if n < len(numbers):
            numbers[n], spring[n], length[n] = e, stiffness[e], delta
            counted[n] = 1.0 if e < n_counted else 0.0
            for i in range(4):
                beta[n, i] = b[i]
            for k in range(3):
                normal[n, k] = u[k]
        n += 1
    return n_active, n


@kernel()
def spring_forces(delta, gap, lower_bound, force, stiffness):  # type: ignore[no-untyped-def]
    """Write −b′ / k [m] and b″ / k at distances (n,) [m]; below lower_bound (n,) [m] the law is its tangent
    there.
    """
    for m in range(len(delta)):
        at = max(delta[m], lower_bound[m])
        if at >= gap[m]:
            force[m] = stiffness[m] = 0.0
            continue
        _, slope, stiffness[m] = barrier(at, gap[m])
        force[m] = stiffness[m] * (at - delta[m]) - slope


@kernel()
def secant_stiffness(delta, gap, lower_bound, force, expected, out):  # type: ignore[no-untyped-def]
    """Slopes (n,) of `spring_forces` between ``force`` (n,) [m] and ``expected`` (n,) [m]; the tangent if
    both agree.
    """
    for m in range(len(delta)):
        _, slope, second = barrier(lower_bound[m], gap[m])
        if expected[m] <= 0.0:
            end = gap[m]
        elif expected[m] >= -slope:
            end = lower_bound[m] - (expected[m] + slope) / second
        else:
            end = distance_of_force(expected[m], gap[m])
        if abs(end - delta[m]) > MIN_CHORD * gap[m]:
            out[m] = max(0.0, (expected[m] - force[m]) / (delta[m] - end))
        else:
            out[m] = barrier(max(delta[m], lower_bound[m]), gap[m])[2] if delta[m] < gap[m] else 0.0
