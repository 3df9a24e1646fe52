"""Stiffness of loads that follow the shape, in equilibria.

A pressure depends on the shape. If solves take it as constant, equilibria are found by fixed-point iteration:
in many solves, and not at all where the pressure's stiffness exceeds that of the sheet. A solve therefore
takes it as linear in the displacement u from its initial shape, f + K u with the symmetric part of K, which
has the potential −fᵀu − ½ uᵀK u for line searches. Where K is symmetric, as for an even pressure on a closed
sheet or one with a fixed rim, that is Newton's method for the load. Beside free edges K is not symmetric:
``newton_displacement`` finds the displacement with all of K, and the force of its skew part is given to the
solve. The K of a moment on an edge is skew: it is that of the forces ± M L γ on the ends
(`terms.loads.moment`), by which the moment turns with its edge.

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

MAX_ITERATIONS, TOLERANCE = 10, 1e-3
"""Largest number of GMRES iterations for a displacement, and their relative tolerance."""

STEP = 1e-5
"""Displacement of the finite differences, over the size of the elements."""

Solve = Callable[[Array], "Array | None"]


def following_stiffness(
    term: Term, x: Array, force: Callable[[Term, Array, Array], None]
) -> tuple[Array, Array]:
    """Symmetric and skew part of −∂f/∂x of each element [N/m], both (E, n, n, 3, 3), at x (n_local, 3).

    They are finite differences of ``force``, which adds the forces [N] of a term at positions to an array.
    Elements get points of their own, so that a point can be moved in all elements at once.
    """
    n_elements, n = term.stencil.shape
    separate = copy.copy(term)
    numbers = np.arange(n_elements * n, dtype=np.int32).reshape(n_elements, n)
    separate.set_elements(Elements(numbers, term.elements.data, term.n_owned))
    corners = x[term.stencil]
    step = STEP * float(np.ptp(corners, axis=1).max(initial=0.0)) or STEP
    out = np.empty((n_elements, n, n, 3, 3))
    for point in range(n):
        for axis in range(3):
            change = np.zeros((n_elements * n, 3))
            for sign in (1.0, -1.0):
                moved = corners.copy()
                moved[:, point, axis] += sign * step
                forces = np.zeros_like(change)
                force(separate, moved.reshape(-1, 3), forces)
                change += sign * forces
            out[:, :, point, :, axis] = -change.reshape(n_elements, n, 3) / (2.0 * step)
    other = out.transpose(0, 2, 1, 4, 3)
    return 0.5 * (out + other), 0.5 * (out - other)


class FollowingLoads:
    """Loads that are linear in the displacement from a shape.

    Parameters
    ----------
    loads : sequence of Term
        Loads that follow the shape.
    x : (n_local, 3)
        The shape [m].
    force_of : callable
        Adds the force [N] of a load at positions to an array.
    """

    def __init__(
        self,
        loads: Sequence[Term],
        x: Array,
        force_of: Callable[[Any, Array, Array], None],
    ) -> None:
        self._from = x.copy()
        self._parts = []
        for load in loads:
            symmetric, skew = following_stiffness(load, x, force_of)
            self._parts.append((load.stencil, symmetric, skew, load.n_owned))

    def _forces(self, x: Array) -> Iterator[tuple[NDArray[np.int32], Array, Array, int]]:
        """Stencil, u (E, n, 3) [m], K u (E, n, 3) [N] and number of owned elements of each load."""
        displacement = x[: len(self._from)] - self._from
        for stencil, blocks, _, n_owned in self._parts:
            u = displacement[stencil]
            yield stencil, u, -np.einsum("eabij,ebj->eai", blocks, u), n_owned

    def energy(self, x: Array) -> float:
        """−½ uᵀK u [J] of the owned elements at positions x (n_local, 3)."""
        return -sum(0.5 * float(np.vdot(u[:n], force[:n])) for _, u, force, n in self._forces(x))

    def add_force(self, x: Array, out: Array) -> None:
        """Add K u [N] to out (n_owned, 3)."""
        for stencil, _, force, _ in self._forces(x):
            _scatter(stencil, force, out, len(x))

    def skew_force(self, displacement: Array, n_owned: int) -> Array:
        """Force (n_owned, 3) [N] of the skew part of K for a displacement (n_local, 3) [m]."""
        out = np.zeros((n_owned, 3))
        for stencil, _, blocks, _ in self._parts:
            force = -np.einsum("eabij,ebj->eai", blocks, displacement[stencil])
            _scatter(stencil, force, out, len(displacement))
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
    """The operator force ↦ force − skew part × (symmetric part)⁻¹ × force."""

    def __init__(self, solve: Solve, skew: Callable[[Array], Array]) -> None:
        self._solve, self._skew = solve, skew

    def mult(self, matrix: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        force = x.getArray(readonly=True).reshape(-1, 3)
        displacement = self._solve(force)
        y.setArray((force if displacement is None else force - self._skew(displacement)).ravel())


def newton_displacement(
    force: Array, solve: Solve, skew: Callable[[Array], Array], comm: MPI.Comm
) -> Array | None:
    """Displacement (n, 3) [m] for a force (n, 3) [N] with symmetric and skew stiffness; collective.

    It is found by GMRES (``-loads_ksp_``), preconditioned from the right with the symmetric part. None if
    there are no factors.

    Parameters
    ----------
    solve : callable
        The displacement for a force by the symmetric part of the stiffness, loads included.
    skew : callable
        Force of the loads' skew part for a displacement.
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
    ksp.setTolerances(rtol=TOLERANCE, max_it=MAX_ITERATIONS)
    ksp.setFromOptions()
    ksp.solve(b, u)
    displacement = solve(u.getArray(readonly=True).reshape(-1, 3))
    for owned in (ksp, b, u, matrix):
        owned.destroy()
    return displacement
