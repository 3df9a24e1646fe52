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

import copy
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.kernels.scatter import add_elements
from lyra_petsc.linear.pattern import BlockPattern
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.terms.term import Term

MOST_WAYS, ENOUGH = 10, 1e-3
"""Iterations for a displacement, and the part of the force that it may leave."""

STEP = 1e-5
"""Displacement in a difference of forces, over the size of the elements."""

Solve = Callable[[Array], "Array | None"]


def following_stiffness(
    term: Term, x: Array, force: Callable[[Term, Array, Array], None]
) -> tuple[Array, Array]:
    """Symmetric and skew part of −∂f/∂x of each element [N/m], each (E, n, n, 3, 3), at x (n_local, 3), by
    differences of its force.

    ``force`` adds the forces [N] of a term at positions to an array. The term's elements are pulled apart,
    so that each of their points can be moved in all at once.
    """
    n_elements, n = term.stencil.shape
    apart = copy.copy(term)
    numbers = np.arange(n_elements * n, dtype=np.int32).reshape(n_elements, n)
    apart.take(Elements(numbers, term.elements.data, term.n_owned))
    here = x[term.stencil]
    step = STEP * float(np.ptp(here, axis=1).max(initial=0.0)) or STEP
    out = np.empty((n_elements, n, n, 3, 3))
    for point in range(n):
        for axis in range(3):
            change = np.zeros((n_elements * n, 3))
            for sign in (1.0, -1.0):
                moved = here.copy()
                moved[:, point, axis] += sign * step
                forces = np.zeros_like(change)
                force(apart, moved.reshape(-1, 3), forces)
                change += sign * forces
            out[:, :, point, :, axis] = -change.reshape(n_elements, n, 3) / (2.0 * step)
    other = out.transpose(0, 2, 1, 4, 3)
    return 0.5 * (out + other), 0.5 * (out - other)


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
        for load in loads:
            symmetric, skew = following_stiffness(load, x, force_of)
            self._parts.append((load.stencil, factor * symmetric, factor * skew, load.n_owned))

    def _forces(self, x: Array) -> Iterator[tuple[NDArray[np.int32], Array, Array, int]]:
        """Of each load its stencil, displacements u (E, n, 3) [m], K u (E, n, 3) [N], and how many elements
        this rank counts.
        """
        ahead = x[: len(self._from)] - self._from
        for stencil, blocks, _, n_owned in self._parts:
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
        for stencil, _, blocks, _ in self._parts:
            _scatter(stencil, -np.einsum("eabij,ebj->eai", blocks, way[stencil]), out, len(way))
        return out

    def add_hessian(self, weight: float, pattern: BlockPattern, values: Array) -> None:
        """Add −weight K to block rows (n_blocks, 3, 3)."""
        for stencil, blocks, _, _ in self._parts:
            add_elements(np.full(len(stencil), weight), blocks, pattern.offsets_of(stencil), values)


def _scatter(stencil: NDArray[np.int32], force: Array, out: Array, n: int) -> None:
    """Add forces (E, n, 3) on stencils to out (n_owned, 3), of ``n`` local rows."""
    for axis in range(3):
        out[:, axis] += np.bincount(stencil.ravel(), force[:, :, axis].ravel(), n)[: len(out)]


class _Preconditioned:
    """Forces less those by the skew part on the displacements that the symmetric part has for them."""

    def __init__(self, solve: Solve, skew: Callable[[Array], Array]) -> None:
        self._solve, self._skew = solve, skew

    def mult(self, matrix: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        force = x.getArray(readonly=True).reshape(-1, 3)
        way = self._solve(force)
        y.setArray((force if way is None else force - self._skew(way)).ravel())


def newton_way(force: Array, solve: Solve, skew: Callable[[Array], Array], comm: MPI.Comm) -> Array | None:
    """Displacement (n, 3) [m] to which a force (n, 3) [N] leads with a skew stiffness, too; None where there
    are no factors; collective.

    GMRES (``-loads_ksp_``), whose preconditioner from the right is the symmetric part.

    Parameters
    ----------
    solve : callable
        The displacement that the symmetric part of the stiffness, loads included, has for a force.
    skew : callable
        Force by the loads' skew part on a displacement.
    """
    local = (force.size, None)
    matrix = PETSc.Mat().createPython((local, local), _Preconditioned(solve, skew), comm)
    matrix.setUp()
    b, u = matrix.createVecs()
    b.setArray(force.ravel())
    ksp = PETSc.KSP().create(comm)
    ksp.setOperators(matrix)
    ksp.setOptionsPrefix("loads_")
    ksp.setType("gmres")
    ksp.getPC().setType("none")
    ksp.setTolerances(rtol=ENOUGH, max_it=MOST_WAYS)
    ksp.setFromOptions()
    ksp.solve(b, u)
    way = solve(u.getArray(readonly=True).reshape(-1, 3))
    for each in (ksp, b, u, matrix):
        each.destroy()
    return way
