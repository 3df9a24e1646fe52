"""Springs with the law of a barrier on distances linear in a Newton step: what touches, or may on its way.

A spring is δ = δ_0 + Σ_i β_i n · w_i long for ways w_i of its four points, and pushes as the barrier does;
those of obstacles, with numbers below 0, stand still.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import kernel
from lyra_petsc.kernels.vectors import add_outers
from lyra_petsc.terms import contact_pairs
from lyra_petsc.terms.term import Offsets

BELOW = 0.5
"""Part of the gap, or of the distance that there is where that is less, below which the law goes on along its
tangent: linear systems are then no stiffer than the sheet. Forces, and distances for them, are found again by
what is expected of them."""


class Springs(NamedTuple):
    """Springs of one term.

    Attributes
    ----------
    at : (m,) int64
        Numbers of its elements, one of which may be there several times.
    points : (m, 4) int64
        Local rows; below 0 of obstacles.
    beta, normal : (m, 4), (m, 3)
        β and unit normals n.
    scale, gap, length : (m,)
        How often each counts times the barrier's k [N/m], gap [m] and distance less offset δ [m].
    counted : (m,)
        How often each counts for this rank.
    acts : (m,) bool
        Which are in the term's gradient and Hessian already.
    """

    at: NDArray[np.int64]
    points: NDArray[np.int64]
    beta: Array
    normal: Array
    scale: Array
    gap: Array
    length: Array
    counted: Array
    acts: NDArray[np.bool_]

    def longer(self, way: Array) -> Array:
        """By how much they become longer (m,) [m] on a way (n_local, 3) [m]."""
        out = np.empty(len(self.at))
        _lengthen(self.points, self.beta, self.normal, way, out)
        return out

    @property
    def _least(self) -> Array:
        """Lengths (m,) [m] below which the law goes on along its tangent."""
        return BELOW * np.minimum(self.gap, self.length)

    def law(self, length: Array) -> tuple[Array, Array]:
        """Forces (m,) [N] and stiffness (m,) [N/m] at these lengths (m,) [m]."""
        force, stiffness = np.empty((2, len(self.at)))
        contact_pairs.law(length, self.gap, self._least, force, stiffness)
        return self.scale * force, self.scale * stiffness

    def chords(self, length: Array, force: Array, expected: Array) -> Array:
        """Slopes (m,) [N/m] of the law from lengths (m,) [m], where it is ``force`` (m,) [N], to where it is
        what is expected (m,) [N].
        """
        out = np.empty(len(self.at))
        contact_pairs.chords(length, self.gap, self._least, force / self.scale, expected / self.scale, out)
        return self.scale * out

    def add_forces(self, size: Array, out: Array) -> None:
        """Add ``size`` (m,) [N] times the gradients of their lengths to rows of out (n_local, 3)."""
        _add_forces(self.points, self.beta, self.normal, size, out)

    def add_stiffness(self, stiffness: Array, offsets: Offsets, values: Array) -> None:
        """Add Hessians of springs of a ``stiffness`` (m,) that push and pull to block rows (n_blocks, 3, 3).

        ``offsets`` (E, 10) are those of the term's elements.
        """
        _add_stiffness(self.at, self.points, self.beta, self.normal, stiffness, offsets, values)


@kernel()
def _lengthen(points, beta, normal, way, out):  # type: ignore[no-untyped-def]
    for m in range(len(out)):
        out[m] = 0.0
        for i in range(4):
            if points[m, i] >= 0:
                for k in range(3):
                    out[m] += beta[m, i] * normal[m, k] * way[Index(points[m, i]), k]


@kernel()
def _add_forces(points, beta, normal, size, out):  # type: ignore[no-untyped-def]
    for m in range(len(size)):
        for i in range(4):
            if points[m, i] >= 0:
                for k in range(3):
                    out[Index(points[m, i]), k] += size[m] * beta[m, i] * normal[m, k]


@kernel()
def _add_stiffness(at, points, beta, normal, stiffness, offsets, values):  # type: ignore[no-untyped-def]
    blocks = values.reshape(-1, 9)
    for m in range(len(at)):
        n = normal[m, 0], normal[m, 1], normal[m, 2]
        for a in range(4):
            for b in range(a, 4):
                own, to = stiffness[m] * beta[m, a] * beta[m, b], offsets[at[m], (7 - a) * a // 2 + b]
                if own != 0.0 and points[m, a] >= 0 and points[m, b] >= 0 and to >= 0:
                    add_outers(blocks, to, 0.0, (((own * n[0], own * n[1], own * n[2]), n),))
