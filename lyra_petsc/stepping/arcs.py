"""Newton steps of equilibria along arcs, on which triangles that turn keep their size.

On the tangent, vertices that turn go beside their circles and stretch the sheet by the square of their angle,
which Newton's method must take back. A way u gives every triangle, of deformation gradient F, the gradient
∂u/∂x with spin W and strain ε, if its normal is to stay one. Along an arc it would become::

    F' = exp(W) (1 + ε) F

No positions fit that exactly; those that fit best, min Σ A |∂x'/∂X − F'|², solve a Poisson equation, whose
matrix changes with nothing but what is prescribed, and is factored once.

Sources: Yu, Zhou, Xu, Shi, Bao, Guo & Shum, Mesh editing with Poisson-based gradient field manipulation,
SIGGRAPH 2004; Huang, Tong, Zhou, Bao & Desbrun, Interactive shape interpolation through controllable dynamic
deformation, IEEE TVCG 17 (2011), for spin and strain.
"""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from lyra_petsc.arrays import Array, Mask
from lyra_petsc.kernels.scatter import add_elements
from lyra_petsc.linear.block_rows import BlockRows
from lyra_petsc.linear.matrix import AssembledMatrix
from lyra_petsc.linear.pattern import BlockPattern
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.terms.membrane import Membrane

PREFIX = "arcs_"
"""Of the options of the solver."""

FARTHEST = 0.4
"""Angle [rad] by which a Newton step may turn a triangle: with 0.25 and 0.6 shells take as many iterations or
more, with 1.5 a tenth to a fifth more."""

STRAIGHT = 0.01
"""Angle [rad] by which directors turn at most in steps that are left straight: an arc saves no iteration."""

LOOSE = 1e-9
"""Diagonal over the largest one that holds what nothing else does: where it is."""


def possible(ranks: int) -> bool:
    """Whether this PETSc can factor the matrix."""
    return ranks == 1 or bool(PETSc.Sys.hasExternalPackage("mumps"))


class Arcs:
    """Bends ways to arcs; collective.

    Parameters
    ----------
    equations : StageEquations
        Of a scene with directors on edges, whose stencils stay.
    """

    def __init__(self, equations: StageEquations) -> None:
        self._equations, layout = equations, equations.points
        self._term = next(term for term in equations.active.elastic if isinstance(term, Membrane))
        name, stencil = self._term.name, self._term.stencil
        self._pattern = BlockPattern({name: stencil}, layout.n_owned, layout.n_local)
        data = self._term.elements.data
        one, two = data["inverse"][:, 0], data["inverse"][:, 1]
        self._area, self._slopes = data["area"], np.stack([-one - two, one, two], axis=1)
        self._matrix: AssembledMatrix | None = None
        self._ksp: PETSc.KSP | None = None
        self._held: Mask = np.empty(0, dtype=bool)

    def matter(self, way: Array) -> bool:
        """Whether a way (n_owned, 3) [m/s] turns anything so far that its arc is another one."""
        return self._equations.largest_turn(way * self._equations.stage.c) > STRAIGHT

    def bend(self, v: Array, way: Array, *, strains: bool = True) -> tuple[Array, Array]:
        """The way from v by ``way`` (n_owned, 3) [m/s] along arcs, and on the tangent, as far as no triangle
        turns too far; without ``strains`` all of it, and triangles keep their shape.
        """
        equations = self._equations
        x, ahead = equations.displacement(v, way)
        shape, spin, strain = self._turn(x, ahead)
        turn = np.linalg.norm(spin, axis=1)
        farthest = float(equations.points.global_max(float(turn.max(initial=0.0)))[0])
        part = min(1.0, FARTHEST / farthest) if strains and farthest > 0.0 else 1.0
        ahead, way = part * ahead, part * way
        kept = np.eye(3) + (part * strain if strains else 0.0)
        gradient = _rotations(part * spin) @ (kept @ shape)
        missing = self._area[:, None, None] * (gradient - shape - self._gradients(ahead))
        pulls, corners = self._slopes @ missing.transpose(0, 2, 1), self._term.stencil.ravel()
        forces = [np.bincount(corners, pulls[:, :, i].ravel(), len(x))[: len(way)] for i in range(3)]
        bent = way + self._solve(np.stack(forces, axis=1)) / equations.stage.c
        equations.match_directors(v, way, bent)
        return bent, way

    def _gradients(self, x: Array) -> Array:
        """∂x/∂X (E, 3, 2) of the triangles."""
        found: Array = np.einsum("eci,eck->eik", x[self._term.stencil], self._slopes)
        return found

    def _turn(self, x: Array, ahead: Array) -> tuple[Array, Array, Array]:
        """F (E, 3, 2), spins (E, 3) and strains (E, 3, 3) of the way ``ahead`` from x (n_local, 3)."""
        shape = self._gradients(x)
        u, w = shape[:, :, 0], shape[:, :, 1]
        normal = np.cross(u, w)
        square = np.sum(normal * normal, axis=1, keepdims=True)
        # of triangles without area nothing is known
        over = np.divide(1.0, square, out=np.zeros_like(square), where=square > 0.0)
        dual = over[:, None] * np.stack([np.cross(w, normal), np.cross(normal, u)], axis=1)
        normal *= np.sqrt(over)
        gradient = self._gradients(ahead) @ dual
        turned = -np.einsum("eij,ei->ej", gradient, normal)
        gradient += turned[:, :, None] * normal[:, None, :]
        transposed = gradient.transpose(0, 2, 1)
        skew = 0.5 * (gradient - transposed)
        spin: Array = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
        return shape, spin, gradient - skew

    def _solve(self, forces: Array) -> Array:
        """Ways (n_owned, 3) [m] of the free coordinates by which forces (n_owned, 3) are balanced."""
        mask, free = self._equations.prescribed.mask, self._equations.prescribed.free
        (other,) = self._equations.points.global_max(float(not np.array_equal(mask, self._held)))
        if other:
            self._factor()
        assert self._matrix is not None
        assert self._ksp is not None
        x, b = self._matrix.mat.createVecs()
        b.setArray(np.where(free, forces, 0.0).ravel())
        self._ksp.solve(b, x)
        found: Array = x.getArray(readonly=True).reshape(forces.shape).copy()
        x.destroy()
        b.destroy()
        return found

    def _factor(self) -> None:
        self.destroy()
        layout, rows, mask = self._equations.points, BlockRows(self._pattern), self._equations.prescribed.mask
        self._held = mask.copy()
        size = np.einsum("eck,eck->e", self._slopes, self._slopes)
        (largest,) = layout.global_max(float((self._area * size).max(initial=0.0)))
        values, diagonal = rows.zeros(), np.full(layout.n_owned, LOOSE * largest)
        diagonal[layout.n_vertices :] = 1.0
        rows.set_diagonal(diagonal, values)
        couplings = np.einsum("eak,ebk->eab", self._slopes, self._slopes)
        blocks = couplings[:, :, :, None, None] * np.eye(3)
        add_elements(self._area, blocks, self._pattern.offsets[self._term.name], values)
        rows.constrain(values, mask, rows.beside(mask))
        self._matrix = AssembledMatrix(layout, self._pattern, "aij", prefix=PREFIX)
        self._matrix.set(values)
        self._ksp = ksp = PETSc.KSP().create(layout.comm)
        ksp.setOptionsPrefix(PREFIX)
        ksp.setType(PETSc.KSP.Type.PREONLY)
        ksp.setOperators(self._matrix.mat)
        pc = ksp.getPC()
        pc.setType(PETSc.PC.Type.CHOLESKY)
        if PETSc.Sys.hasExternalPackage("mumps"):
            pc.setFactorSolverType("mumps")
            pc.setFactorSetUpSolverType()
            pc.getFactorMatrix().setOptionsPrefix(PREFIX)  # else it takes the options of the steps' factors
        ksp.setUp()

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
    found: Array = np.eye(3) + first * skew + second * (skew @ skew)
    return found
