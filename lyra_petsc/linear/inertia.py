"""Signs of the eigenvalues of a symmetric stiffness matrix K, and its lowest mode.

By Sylvester's law of inertia a symmetric matrix has as many negative eigenvalues as its LDLᵀ factorisation
has negative pivots (MUMPS, in a KSP with the options prefix ``stability_``). Round-off changes each entry by
up to ε |K|, and such changes lie between −Δ and Δ = ε diag(|K| 1): the negative pivots of K + Δ are certain,
and those of K − Δ that K + Δ lacks are motions whose stiffness is below round-off. Δ is of the size of the
membrane's stiffness in a sheet, and of that of bending across it if the sheet is flat. The matrix that is
factored is Δ^(−½) K Δ^(−½) ± 1.

Rigid motions r of parts that nothing holds have no stiffness, but residuals of the equilibrium give them one
of either sign. As many unknowns are supported as there are rigid motions, such that none is left (statically
determinate). By Haynsworth's formula the inertia of K is that of K with supports plus that of the stiffness
uᵀ K u of the motions that the supports prevent, u = r − K⁻¹ K r with the inverse of K with supports.

Source: Haynsworth, Determination of the inertia of a partitioned Hermitian matrix, Linear Algebra Appl. 1
(1968) 73-81.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from petsc4py import PETSc

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.linear.block_rows import BlockRows
from lyra_petsc.linear.failed_factors import larger_margin
from lyra_petsc.linear.low_rank import FactoredLowRank, LowRank
from lyra_petsc.linear.matrix import AssembledMatrix
from lyra_petsc.linear.pattern import BlockPattern
from lyra_petsc.mesh.points import Layout

PREFIX = "stability_"

EPSILON = float(np.finfo(np.float64).eps)

ROUND_OFF = 32.0 * EPSILON
"""Relative round-off ε of a matrix entry: of the sum over its elements, and of the factors."""

MAX_REFINED = 12
"""Largest number of modes below round-off that are examined one by one."""

GUARDS, MAX_SOLVES, SAME = 4, 100, 1e-3
"""Further vectors in subspace iteration, its maximum number of iterations, and the relative change of the
eigenvalues at which it ends."""

RIGID = 1e-6
"""Mean square change of a rigid motion, relative to its own, by which a motion without supports still counts
as rigid."""

GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0
"""Inverse golden ratio, whose multiples modulo 1 are evenly distributed."""


@dataclass(frozen=True)
class Pivots:
    """Numbers of motions with negative stiffness, of other motions with a stiffness below round-off, and of
    rigid motions without stiffness.
    """

    negative: int
    neutral: int
    rigid: int


class Inertia:
    """Factors a symmetric matrix of block rows; collective.

    Parameters
    ----------
    layout : Layout
    pattern : BlockPattern
    values : (n_stored, 3, 3)
        Block rows of the matrix [N/m], prescribed unknowns not decoupled.
    held : (n_local, 3) bool
        Prescribed unknowns.
    rigid : (m, n_local, 3)
        Rigid motions of parts of the sheet that move no prescribed unknown, linearly independent.
    skew : (m, n_owned, 3)
        Force [N/m] that loads without a potential add to the product of the matrix with the rigid motions.
    doubt : float
        Stiffness [N/m] of the rigid motions below which it counts as zero.
    dense : LowRank or None
        A part of the matrix that is not in the block rows.
    """

    def __init__(
        self,
        layout: Layout,
        pattern: BlockPattern,
        values: Array,
        held: Mask,
        rigid: Array,
        skew: Array,
        doubt: float,
        dense: LowRank | None = None,
    ) -> None:
        self._layout, self._values, self._rows = layout, pattern.in_blocks(values), BlockRows(pattern.whole)
        self._held, self._rigid, self._skew, self._doubt = held, rigid, skew, doubt
        pattern = self._pattern = pattern.whole
        self._row = np.repeat(np.arange(pattern.n_owned), np.diff(pattern.indptr))
        self._diagonal = pattern.indptr[:-1]
        bound = ROUND_OFF * self._rows.product(np.abs(self._values), np.ones((pattern.n_local, 3)))
        (largest,) = layout.global_max(float(bound.max(initial=0.0)))
        self._bound = bound + (EPSILON * largest or 1.0)  # > 0 also where nothing resists
        scale = np.zeros((pattern.n_local, 3))
        scale[: pattern.n_owned] = self._bound**-0.5
        self._decoupled = held[: pattern.n_owned].copy()
        self._decoupled.ravel()[self._supports()] = True
        scale[: pattern.n_owned][self._decoupled] = 0.0
        layout.update_ghosts(scale)
        self._scale = scale
        self._dense = dense and dense.restricted(~held[: pattern.n_owned])
        self._scaled_dense = self._dense and self._dense.restricted(scale[: pattern.n_owned])
        self._factored: FactoredLowRank | None = None
        # blocks are stored column by column
        self._scaled = self._values * scale[pattern.columns][:, :, None] * scale[self._row][:, None, :]
        self._scaled[self._diagonal] += self._decoupled[:, :, None] * np.eye(3) / ROUND_OFF
        self._matrix = AssembledMatrix(layout, pattern, "aij", prefix=PREFIX)
        self._ksp: PETSc.KSP | None = None
        self._margin = 50
        self._shift: float | None = None  # of the factors
        # motions that the supports prevent, by their stiffness over round-off, and the lowest others
        self._supported_motions: Array | None = None
        self._stiffness = np.empty(0)
        self._modes: Array | None = None

    def _supports(self) -> Ints:
        """Indices of the unknowns on this rank, in flattened owned rows, that prevent all rigid motions."""
        layout, own = self._layout, np.empty(0, dtype=np.int64)
        left = self._rigid[:, : layout.n_owned].reshape(len(self._rigid), 3 * layout.n_owned).copy()
        for _ in range(len(left)):
            squares = (left**2).sum(axis=0)
            place = int(squares.argmax()) if squares.size else 0
            largest = float(squares[place]) if squares.size else -1.0
            rank = int(np.argmax(layout.comm.allgather(largest)))
            if rank == layout.comm.rank:
                own = np.append(own, place)
            motion = layout.comm.bcast(left[:, place] if rank == layout.comm.rank else None, rank)
            left -= np.outer(motion / (motion @ motion), motion @ left)
        return own

    def pivots(self) -> Pivots | None:
        """Numbers of motions without positive stiffness; None if the factors do not fit into memory."""
        lowered = self._negative(-1.0)
        negative = self._negative(1.0) if lowered else 0
        if lowered is None or negative is None:
            return None
        neutral = lowered - negative
        supported = self._examine_rigid_motions()
        if not negative and 0 < neutral <= MAX_REFINED:
            negative, neutral = self._examine_modes(neutral)
        return Pivots(negative + supported[0], neutral + supported[1], supported[2])

    def _negative(self, shift: float) -> int | None:
        """Number of negative pivots of the scaled matrix plus a shift; None without memory."""
        values, self._shift = self._scaled.copy(), None
        values[self._diagonal] += shift * np.eye(3)
        self._matrix.set(values)
        while True:
            factors = self._factor()
            if factors.getMumpsInfog(1) >= 0:
                self._shift = shift
                negative = int(factors.getMumpsInfog(12))
                if self._scaled_dense is not None:
                    self._factored = self._scaled_dense.with_factors(self._solve_rows)
                    negative -= self._factored.fewer
                return negative
            margin = larger_margin(factors)
            if margin is None:
                return None
            self._margin = margin

    def _solve_rows(self, force: Array) -> Array:
        """Solution (n_owned, 3) of the block rows that are factored."""
        assert self._ksp is not None
        return self._matrix.solve(self._ksp, force)

    def _solve_scaled(self, force: Array) -> Array:
        """Solution (n_owned, 3) of the whole matrix, scaled and shifted."""
        return self._factored.solve(force) if self._factored else self._solve_rows(force)

    def _scaled_product(self, u: Array) -> Array:
        """Product (n_owned, 3) of the scaled matrix with u (n_local, 3)."""
        product = self._rows.product(self._scaled, u)
        return product + self._scaled_dense.product(u[: len(product)]) if self._scaled_dense else product

    def _factor(self) -> PETSc.Mat:
        self._free_solver()
        self._ksp = ksp = self._matrix.cholesky()
        factors = ksp.getPC().getFactorMatrix()
        # no further scaling; count all pivots, also those of the last dense block
        for number, value in {6: 0, 8: 0, 13: 1, 14: self._margin}.items():
            factors.setMumpsIcntl(number, value)
        factors.setMumpsCntl(1, 0.01)
        ksp.setUp()
        return factors

    def _examine_rigid_motions(self) -> tuple[int, int, int]:
        """Numbers of motions of supports with negative stiffness, below round-off, and rigid without any."""
        count, n = len(self._rigid), self._pattern.n_owned
        if not count:
            self._supported_motions = np.empty((0, n, 3))
            return 0, 0, 0
        change = -np.array([self._supported(self._product(motion)) for motion in self._rigid])
        whole = change - np.array([self._supported(force) for force in self._skew])
        vertices = np.s_[:, : self._layout.n_vertices]
        squares = self._dots(self._rigid[vertices], self._rigid[vertices])
        # combined such that each is as rigid, or as little, as possible: springs and clamps bend the sheet
        ratio, mixed = _scaled_eigenvalues(self._dots(whole[vertices], whole[vertices]), squares)
        rigid = ratio <= RIGID
        motions = np.tensordot(mixed.T, self._rigid[:, :n], 1)
        motions += np.where(rigid[:, None, None], *(np.tensordot(mixed.T, u, 1) for u in (whole, change)))
        stiffness, unsure = self._accurate_stiffness(np.array([self._with_ghosts(u) for u in motions]))
        unsure += np.where(rigid, self._doubt * (mixed**2).sum(axis=0), 0.0)
        values, vectors = _scaled_eigenvalues(stiffness, np.diag(unsure))
        sure = np.abs(values) > 1.0
        share = ((np.sqrt(unsure)[:, None] * vectors)[rigid] ** 2).sum(axis=0)
        without = int((~sure & (share > 0.5)).sum())
        self._supported_motions = np.tensordot(vectors[:, sure].T, motions, 1)
        self._stiffness = values[sure]
        return int((self._stiffness < 0.0).sum()), int((~sure).sum()) - without, without

    def _examine_modes(self, count: int) -> tuple[int, int]:
        """Numbers of the lowest ``count`` modes with negative and without stiffness.

        Their stiffness is calculated from differences of displacements, in which translations cancel.
        """
        modes = np.array([self._with_ghosts(mode) for mode in self._lowest_modes(1.0, count)])
        stiffness, unsure = self._accurate_stiffness(modes)
        values, vectors = _scaled_eigenvalues(stiffness, np.diag(unsure))
        self._modes = np.tensordot(vectors.T, modes[:, : self._pattern.n_owned], 1)
        return int((values < -1.0).sum()), int((np.abs(values) <= 1.0).sum())

    def _accurate_stiffness(self, modes: Array) -> tuple[Array, Array]:
        """Stiffness uᵀ K v (m, m) of modes (m, n_local, 3), and its round-off between ± diag(b), b (m,).

        With the sums Eᵢ of the blocks of a row, and the symmetric and skew part S and A of a block, vertices
        i and pairs i, j contribute
        Σ uᵢᵀ Eᵢ vᵢ − Σ (uᵢ − uⱼ)ᵀ S (vᵢ − vⱼ) + Σ (uᵢᵀ A (vⱼ − vᵢ) + vᵢᵀ A (uⱼ − uᵢ)).
        """
        pattern, layout = self._pattern, self._layout
        vertex = layout.are_vertices(layout.global_number)
        row, column = self._row, pattern.columns
        blocks = self._values.transpose(0, 2, 1)
        among = vertex[row] & vertex[column]
        part = np.where(column < pattern.n_owned, 1.0, 0.5)  # others hold pairs with ghosts, too
        pairs = np.flatnonzero(among & (row != column))
        i, j, weight = row[pairs], column[pairs], part[pairs]
        symmetric = 0.5 * weight[:, None, None] * (blocks[pairs] + blocks[pairs].transpose(0, 2, 1))
        skew = weight[:, None, None] * blocks[pairs] - symmetric
        sums, size = (
            np.stack([self._rows.product(entries, vertex[:, None] * axis) for axis in np.eye(3)], axis=2)
            for entries in (np.where(among[:, None, None], self._values, 0.0), np.abs(self._values))
        )
        sums[np.abs(sums) <= ROUND_OFF * size] = 0.0  # no energy depends on translations
        own = slice(0, layout.n_vertices)
        others = np.where(among[:, None, None], 0.0, self._values)

        def form(u: Array, v: Array, blocks: tuple[Array, Array, Array, Array], sign: float) -> float:
            sums, symmetric, skew, others = blocks
            change = [np.abs(w[i] - w[j]) if sign > 0.0 else w[i] - w[j] for w in (u, v)]
            total = np.einsum("na,nab,nb->", u[own], sums[own], v[own])
            total += sign * np.einsum("na,nab,nb->", change[0], symmetric, change[1])
            total += sign * np.einsum("na,nab,nb->", u[i], skew, change[1])
            total += sign * np.einsum("na,nab,nb->", v[i], skew, change[0])
            total += np.vdot(u[: pattern.n_owned], self._rows.product(others, v))
            return float(layout.global_sum(float(total))[0])

        parts = sums, symmetric, skew, others
        sizes = np.abs(sums), np.abs(symmetric), np.abs(skew), np.abs(others)
        stiffness = np.array([[form(u, v, parts, -1.0) for v in modes] for u in modes])
        if self._dense:
            stiffness += self._dense.forms(modes[:, : pattern.n_owned], modes[:, : pattern.n_owned])
        sizes_of_modes = np.abs(modes)
        round_off = np.array([[form(u, v, sizes, 1.0) for v in sizes_of_modes] for u in sizes_of_modes])
        # not zero for translations, whose differences vanish
        least = EPSILON * self._dots(modes[:, : pattern.n_owned], self._bound * modes[:, : pattern.n_owned])
        return stiffness, ROUND_OFF * round_off.sum(axis=1) + least.diagonal()

    def _lowest_modes(self, shift: float, count: int) -> Array:
        """Modes (count, n_owned, 3) with the lowest stiffness over Δ, by subspace iteration.

        The matrix with this shift has been factored last, and is positive definite.
        """
        layout, n = self._layout, self._pattern.n_owned
        # evenly distributed in (-1/2, 1/2), the same on any number of ranks
        number = 3 * layout.mesh_vertices[:, None] + np.arange(3) + 1
        modes = np.zeros((min(count + GUARDS, self._size), n, 3))
        for k, mode in enumerate(modes):
            mode[: layout.n_vertices] = (number * (k + 1) * GOLDEN) % 1.0 - 0.5
        modes[:, self._decoupled] = 0.0
        before = np.full(count, np.inf)
        for _ in range(MAX_SOLVES):
            modes = np.array([self._solve_scaled(mode) for mode in modes])
            squares, vectors = np.linalg.eigh(self._dots(modes, modes))
            kept = squares > EPSILON * squares[-1]
            modes = np.tensordot((vectors[:, kept] / np.sqrt(squares[kept])).T, modes, 1)
            products = np.array([self._scaled_product(self._with_ghosts(u)) for u in modes])
            values, vectors = np.linalg.eigh(self._dots(modes, products))
            modes = np.tensordot(vectors.T, modes, 1)
            lowest = values[:count]
            if len(lowest) == len(before) and np.all(np.abs(lowest - before) <= SAME * np.abs(lowest) + SAME):
                break
            before = lowest
        return modes[:count] * self._scale[:n]

    def lowest_mode(self) -> Array | None:
        """A displacement (n_owned, 3) of length one with negative stiffness, or None; after `pivots`.

        None if there is none, or no memory.
        """
        if self._modes is not None:
            mode = self._modes[0]
        elif self._supported_motions is not None and np.any(self._stiffness < 0.0):
            mode = self._supported_motions[0]
        else:
            shift = 1.0
            while negative := self._negative(shift):
                shift *= 100.0
            if negative is None:
                return None
            mode = self._lowest_modes(shift, 1)[0]
        length = float(np.sqrt(self._dots(mode[None], mode[None])[0, 0]))
        return mode / length if length > 0.0 else None

    def solve(self, force: Array) -> Array | None:
        """Displacement (n_owned, 3) [m] for a force (n_owned, 3) [N]; None if there is no memory.

        Rigid motions without stiffness are left out.
        """
        if self._shift != 0.0 and self._negative(0.0) is None:
            return None
        if self._supported_motions is None:
            self._examine_rigid_motions()
        assert self._supported_motions is not None
        parts = self._dots(self._supported_motions, force[None])[:, 0] / self._stiffness
        displacement: Array = self._supported(force) + np.tensordot(parts, self._supported_motions, 1)
        return displacement

    def _supported(self, force: Array) -> Array:
        """Displacement (n_owned, 3) [m] for a force (n_owned, 3) [N] of the matrix with supports."""
        scale = self._scale[: len(force)]
        displacement: Array = scale * self._solve_scaled(scale * force)
        return displacement

    def _product(self, u: Array) -> Array:
        """The force (n_owned, 3) on unknowns that are not prescribed, for a displacement (n_local, 3)."""
        n = self._pattern.n_owned
        product = self._rows.product(self._values, u)
        if self._dense:
            product += self._dense.product(u[:n])
        return np.where(self._held[:n], 0.0, product)

    def _with_ghosts(self, owned: Array) -> Array:
        local = np.zeros((self._pattern.n_local, 3))
        local[: len(owned)] = owned
        self._layout.update_ghosts(local)
        return local

    @property
    def _size(self) -> int:
        """Number of unknowns that are not decoupled."""
        return int(self._layout.global_sum(float((~self._decoupled).sum()))[0])

    def _dots(self, one: Array, other: Array) -> Array:
        """Scalar products (m, k) of vectors (m, n_owned, 3) and (k, n_owned, 3)."""
        products = np.tensordot(one, other, ((1, 2), (1, 2)))
        return self._layout.global_sum(*products.ravel()).reshape(products.shape)

    def _free_solver(self) -> None:
        if self._ksp is not None:
            self._ksp.destroy()
            self._ksp = None

    def destroy(self) -> None:
        """Free the factors and the matrix; collective."""
        self._free_solver()
        self._matrix.destroy()


def _scaled_eigenvalues(matrix: Array, scale: Array) -> tuple[Array, Array]:
    """Ascending eigenvalues (m,) and vectors (m, m), in columns, of matrix − λ scale, by vᵀ scale v = 1."""
    root = np.linalg.inv(np.linalg.cholesky(scale))
    values, vectors = np.linalg.eigh(0.5 * root @ (matrix + matrix.T) @ root.T)
    return values, root.T @ vectors
