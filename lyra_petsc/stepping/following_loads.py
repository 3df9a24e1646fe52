"""Loads of an equilibrium that follow the shape: their stiffness, and what they are along it.

A pressure is known at a shape only, and changes with it. Where a solve takes it as it was, equilibria are
found as a fixed point is: in many solves, and not at all where it changes by more than the sheet resists. So
a solve takes it as linear in the displacement u from the shape it begins from, f + K u with the symmetric
part of K, which has the potential −fᵀu − ½ uᵀK u that line searches need. Where all of K is symmetric, as for
an even pressure on a closed sheet or one whose rim is held, that is Newton's method for the load. Beside free
edges it is not: ``newton_way`` finds the displacement that all of K leads to, whose skew part f is given.

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

MOST_WAYS, ENOUGH, ROUNDING = 10, 1e-3, 1e-12
"""Solves for a displacement, the part of the force that it may leave, and what of a unit force is none."""


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
        self._parts = []
        self._skew = []
        for load in loads:
            symmetric, skew = following_stiffness(load, x, force_of)
            self._parts.append((load.stencil, factor * symmetric, load.n_owned))
            self._skew.append((load.stencil, factor * skew))

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
            _scatter(stencil, force, out, len(x))

    def skew_force(self, way: Array, n_owned: int) -> Array:
        """Force (n_owned, 3) [N] by the skew part of K on a displacement (n_local, 3) [m]."""
        out = np.zeros((n_owned, 3))
        for stencil, blocks in self._skew:
            _scatter(stencil, -np.einsum("eabij,ebj->eai", blocks, way[stencil]), out, len(way))
        return out

    def add_hessian(self, weight: float, pattern: BlockPattern, values: Array) -> None:
        """Add −weight K to block rows (n_blocks, 3, 3)."""
        for stencil, blocks, _ in self._parts:
            add_elements(np.full(len(stencil), weight), blocks, pattern.offsets_of(stencil), values)


def _scatter(stencil: NDArray[np.int32], force: Array, out: Array, n: int) -> None:
    """Add forces (E, n, 3) on stencils to out (n_owned, 3), of ``n`` local rows."""
    for axis in range(3):
        out[:, axis] += np.bincount(stencil.ravel(), force[:, :, axis].ravel(), n)[: len(out)]


def newton_way(
    force: Array,
    solve: Callable[[Array], Array | None],
    skew: Callable[[Array], Array],
    summed: Callable[[Array], Array],
) -> Array | None:
    """Displacement (n, 3) [m] to which a force (n, 3) [N] leads with a skew stiffness, too; None where there
    are no factors; collective.

    GMRES, whose preconditioner is the symmetric part (Saad, Iterative Methods for Sparse Linear Systems,
    2nd ed. 2003, section 9.3.2).

    Parameters
    ----------
    solve : callable
        The displacement that the symmetric part of the stiffness, loads included, has for a force.
    skew : callable
        Force by the loads' skew part on a displacement.
    summed : callable
        Sums over all ranks.
    """
    size = float(np.sqrt(summed(np.array([np.vdot(force, force)]))[0]))
    if size == 0.0:
        return np.zeros_like(force)
    basis, ways = [force / size], []
    table = np.zeros((MOST_WAYS + 1, MOST_WAYS))
    part = np.empty(0)
    for k in range(MOST_WAYS):
        way = solve(basis[k])
        if way is None:
            return None
        ways.append(way)
        rest = basis[k] - skew(way)
        for _ in range(2):  # rounding spoils what is made orthogonal once
            parts = summed(np.array([np.vdot(each, rest) for each in basis]))
            table[: k + 1, k] += parts
            rest = rest - np.tensordot(parts, basis, 1)
        table[k + 1, k] = np.sqrt(summed(np.array([np.vdot(rest, rest)]))[0])
        goal = np.append(size, np.zeros(k + 1))
        part = np.linalg.lstsq(table[: k + 2, : k + 1], goal, rcond=None)[0]
        left = float(np.linalg.norm(goal - table[: k + 2, : k + 1] @ part))
        if left <= ENOUGH * size or table[k + 1, k] <= ROUNDING:
            break
        basis.append(rest / table[k + 1, k])
    found: Array = np.tensordot(part, ways, 1)
    return found
