"""Newton steps of equilibria along arcs, on which triangles that rotate keep their size.

A linear increment that rotates a triangle by an angle stretches it by the square of the angle, and later
iterations must remove the stretch. An increment u from the deformation gradient F of a triangle has the
gradient ∂u/∂x, with spin W and strain ε if the normal stays a normal. Along an arc the deformation gradient
becomes::

    F' = exp(W) (1 + ε) F

No positions fit all F' exactly. The best fit, min Σ A |∂x'/∂X − F'|², solves a Poisson equation, whose matrix
depends on the prescribed unknowns only and is factored once.

Sources: Yu, Zhou, Xu, Shi, Bao, Guo & Shum, Mesh editing with Poisson-based gradient field manipulation,
SIGGRAPH 2004; Huang, Tong, Zhou, Bao & Desbrun, Interactive shape interpolation through controllable dynamic
deformation, IEEE TVCG 17 (2011), for spin and strain.
"""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.kernels.scatter import add_elements
from lyra_petsc.linear.block_rows import BlockRows
from lyra_petsc.linear.matrix import AssembledMatrix
from lyra_petsc.linear.pattern import BlockPattern
from lyra_petsc.stepping.directors import match
from lyra_petsc.stepping.prescribed import PrescribedUnknowns
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.terms.membrane import Membrane

PREFIX = "arcs_"
"""Options prefix of the linear solver."""

MAX_TURN = 0.4
"""Largest angle [rad] by which a Newton step may turn a triangle.

With 0.25 and 0.6 shells take as many iterations or more, with 1.5 a tenth to a fifth more."""

MIN_TURN = 0.01
"""Largest rotation [rad] of directors for which a step stays linear: an arc would save no iteration."""

REGULARISATION = 1e-9
"""Diagonal entry, over the largest one, that makes the matrix regular without prescribed unknowns."""


def can_factor(ranks: int) -> bool:
    """Whether this PETSc can factor a matrix on so many ranks."""
    return ranks == 1 or bool(PETSc.Sys.hasExternalPackage("mumps"))


class Arcs:
    """Changes linear increments to increments along arcs; collective.

    Parameters
    ----------
    equations : StageEquations
        System of a scene with directors on edges.
    """

    def __init__(self, equations: StageEquations) -> None:
        self._equations = equations
        self._term = next(term for term in equations.active.elastic if isinstance(term, Membrane))
        data = self._term.elements.data
        one, two = data["inverse"][:, 0], data["inverse"][:, 1]
        self._area, self._slopes = data["area"], np.stack([-one - two, one, two], axis=1)
        self._matrix: AssembledMatrix | None = None
        self._ksp: PETSc.KSP | None = None
        self._factored_for = -1

    def turns_notably(self, increment: Array) -> bool:
        """Whether an increment (n_owned, 3) [m/s] rotates directors so far that its arc differs notably."""
        return self._equations.directors.largest_turn(increment * self._equations.step.stage.c) > MIN_TURN

    def curve(self, v: Array, increment: Array, *, strains: bool = True) -> tuple[Array, Array]:
        """An increment (n_owned, 3) [m/s] from v along arcs, and the linear one.

        Both are shortened so that no triangle turns by more than `MAX_TURN`. Without ``strains`` they are not
        shortened, and triangles keep their strain.
        """
        equations = self._equations
        x, displacement = equations.displacement(v, increment)
        deformation, spin, strain = self._spin_and_strain(x, displacement)
        turn = np.linalg.norm(spin, axis=1)
        largest = float(equations.points.global_max(float(turn.max(initial=0.0)))[0])
        part = min(1.0, MAX_TURN / largest) if strains and largest > 0.0 else 1.0
        displacement, increment = part * displacement, part * increment
        stretch = np.eye(3) + (part * strain if strains else 0.0)
        gradient = _rotations(part * spin) @ (stretch @ deformation)
        misfit = self._area[:, None, None] * (gradient - deformation - self._gradients(displacement))
        element_forces, corners = self._slopes @ misfit.transpose(0, 2, 1), self._term.stencil.ravel()
        forces = [
            np.bincount(corners, element_forces[:, :, i].ravel(), len(x))[: len(increment)] for i in range(3)
        ]
        curved = increment + self._solve(np.stack(forces, axis=1)) / equations.step.stage.c
        match(equations, v, increment, curved)
        return curved, increment

    def _gradients(self, x: Array) -> Array:
        """∂x/∂X (E, 3, 2) of the triangles."""
        gradients: Array = np.einsum("eci,eck->eik", x[self._term.stencil], self._slopes)
        return gradients

    def _spin_and_strain(self, x: Array, displacement: Array) -> tuple[Array, Array, Array]:
        """F (E, 3, 2) at x (n_local, 3), and spins (E, 3) and strains (E, 3, 3) of a displacement from x."""
        deformation = self._gradients(x)
        u, w = deformation[:, :, 0], deformation[:, :, 1]
        normal = np.cross(u, w)
        square = np.sum(normal * normal, axis=1, keepdims=True)
        # triangles without area get zeros
        over = np.divide(1.0, square, out=np.zeros_like(square), where=square > 0.0)
        dual = over[:, None] * np.stack([np.cross(w, normal), np.cross(normal, u)], axis=1)
        normal *= np.sqrt(over)
        gradient = self._gradients(displacement) @ dual
        turned = -np.einsum("eij,ei->ej", gradient, normal)
        gradient += turned[:, :, None] * normal[:, None, :]
        transposed = gradient.transpose(0, 2, 1)
        skew = 0.5 * (gradient - transposed)
        spin: Array = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
        return deformation, spin, gradient - skew

    def _solve(self, forces: Array) -> Array:
        """Displacements (n_owned, 3) [m] of the free unknowns by the Poisson equation for ``forces``."""
        prescribed = self._equations.step.prescribed
        if prescribed.number != self._factored_for:
            self._factor(prescribed)
        assert self._matrix is not None
        assert self._ksp is not None
        return self._matrix.solve(self._ksp, np.where(prescribed.free, forces, 0.0))

    def _factor(self, prescribed: PrescribedUnknowns) -> None:
        self.destroy()
        layout, mask, name = self._equations.points, prescribed.mask, self._term.name
        pattern = BlockPattern({name: self._term.stencil}, layout.n_owned, layout.n_local)
        rows = BlockRows(pattern)
        size = np.einsum("eck,eck->e", self._slopes, self._slopes)
        (largest,) = layout.global_max(float((self._area * size).max(initial=0.0)))
        values, diagonal = rows.zeros(), np.full(layout.n_owned, REGULARISATION * largest)
        diagonal[layout.n_vertices :] = 1.0
        rows.set_diagonal(diagonal, values)
        couplings = np.einsum("eak,ebk->eab", self._slopes, self._slopes)
        blocks = couplings[:, :, :, None, None] * np.eye(3)
        add_elements(self._area, blocks, pattern.offsets[name], values)
        rows.constrain(values, mask, rows.constrained_entries(mask))
        self._matrix = AssembledMatrix(layout, pattern, "aij", prefix=PREFIX)
        self._matrix.set(values)
        self._ksp = self._matrix.cholesky()
        self._ksp.setUp()
        self._factored_for = prescribed.number

    def destroy(self) -> None:
        """Free the factors and the matrix; collective."""
        if self._ksp is not None and self._matrix is not None:
            self._ksp.destroy()
            self._matrix.destroy()
        self._ksp = self._matrix = None


def _rotations(spin: Array) -> Array:
    """exp of the cross products with vectors (n, 3) [rad], (n, 3, 3)."""
    angle = np.linalg.norm(spin, axis=1)[:, None, None]
    x, y, z = spin.T
    zero = np.zeros_like(x)
    skew = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    first, second = np.sinc(angle / np.pi), 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    rotations: Array = np.eye(3) + first * skew + second * (skew @ skew)
    return rotations
