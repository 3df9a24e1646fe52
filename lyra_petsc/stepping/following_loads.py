"""Loads of an equilibrium that follow the shape: their stiffness, and what they are along it.

A pressure is known at a shape only, and changes with it. Where a solve takes it as it was, equilibria are
found as a fixed point is: in many solves, and not at all where it changes by more than the sheet resists. So
a solve takes it as linear in the displacement u from the shape it begins from, f + K u with the symmetric
part of K, which has the potential −fᵀu − ½ uᵀK u that line searches need. Where all of K is symmetric, as for
an even pressure on a closed sheet or one whose rim is held, that is Newton's method for the load.

Source: Schweizerhof & Ramm, Displacement dependent pressure loads in nonlinear finite element analyses,
Computers & Structures 18 (1984) 1099-1114.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.kernels.scatter import add_elements
from lyra_petsc.linear.pattern import BlockPattern
from lyra_petsc.terms.load_stiffness import following_stiffness
from lyra_petsc.terms.term import Term


class FollowingLoads:
    """Linear in the displacement from a shape.

    Parameters
    ----------
    loads : sequence of Term
        Those that follow the shape.
    x : (n_local, 3)
        The shape [m].
    force_of : callable
        Adds the force [N] of one of them at positions to an array.
    factor : float
        On all of them.
    """

    def __init__(
        self,
        loads: Sequence[Term],
        x: Array,
        force_of: Callable[[Any, Array, Array], None],
        factor: float,
    ) -> None:
        self._from = x.copy()
        self._parts = [
            (load.stencil, factor * following_stiffness(load, x, force_of), load.n_owned) for load in loads
        ]

    def _forces(self, x: Array) -> Iterator[tuple[NDArray[np.int32], Array, Array, int]]:
        """Of each load its stencil, displacements u (E, n, 3) [m], K u (E, n, 3) [N], and how many elements
        this rank counts.
        """
        ahead = x[: len(self._from)] - self._from
        for stencil, blocks, n_owned in self._parts:
            u = ahead[stencil]
            yield stencil, u, -np.einsum("eabij,ebj->eai", blocks, u), n_owned

    def energy(self, x: Array) -> float:
        """−½ uᵀK u [J] of the elements that this rank counts, at positions x (n_local, 3)."""
        return -sum(0.5 * float(np.vdot(u[:n], force[:n])) for _, u, force, n in self._forces(x))

    def add_force(self, x: Array, out: Array) -> None:
        """Add K u [N] to out (n_owned, 3)."""
        for stencil, _, force, _ in self._forces(x):
            for axis in range(3):
                sums = np.bincount(stencil.ravel(), force[:, :, axis].ravel(), len(x))
                out[:, axis] += sums[: len(out)]

    def add_hessian(self, weight: float, pattern: BlockPattern, values: Array) -> None:
        """Add −weight K to block rows (n_blocks, 3, 3)."""
        for stencil, blocks, _ in self._parts:
            add_elements(np.full(len(stencil), weight), blocks, pattern.offsets_of(stencil), values)
