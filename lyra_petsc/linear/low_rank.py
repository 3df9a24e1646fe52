"""Symmetric matrices G W Gᵀ of a few vectors, added to a sparse matrix A without being assembled.

With A factored, A + G W Gᵀ, W > 0, has the inverse A⁻¹ − A⁻¹ G S⁻¹ Gᵀ A⁻¹ with S = W⁻¹ + Gᵀ A⁻¹ G
(Sherman, Morrison & Woodbury), and as many negative eigenvalues as A has more than S: both are Schur
complements in the matrix [[A, G], [Gᵀ, −W⁻¹]].

Source: Haynsworth, Determination of the inertia of a partitioned Hermitian matrix, Linear Algebra Appl. 1
(1968) 73-81.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lyra_petsc.arrays import Array, Mask
from lyra_petsc.mesh.points import Points


@dataclass(frozen=True, eq=False)
class LowRank:
    """The matrix G W Gᵀ; methods are collective.

    Attributes
    ----------
    points : Points
    weights : (k,)
        The diagonal of W, positive.
    vectors : (k, n_owned, 3)
        The columns of G.
    """

    points: Points
    weights: Array
    vectors: Array

    def product(self, x: Array) -> Array:
        """The product (n_owned, 3) with x (n_owned, 3)."""
        return np.tensordot(self.weights * self._dots(x), self.vectors, 1)

    def forms(self, one: Array, other: Array) -> Array:
        """Products uᵀ G W Gᵀ v (m, n) of vectors (m, n_owned, 3) and (n, n_owned, 3)."""
        u, v = (np.array([self._dots(x) for x in xs]).reshape(len(xs), -1) for xs in (one, other))
        return np.asarray((u * self.weights) @ v.T)

    def restricted(self, scale: Array | Mask) -> LowRank:
        """The same with rows and columns multiplied by ``scale`` (n_owned, 3), or left out if it is False."""
        return LowRank(self.points, self.weights, self.vectors * scale)

    def _dots(self, x: Array) -> Array:
        """Scalar products (k,) of the vectors with x (n_owned, 3)."""
        products = np.tensordot(self.vectors, x, ((1, 2), (0, 1)))
        return self.points.global_sum(*products)

    def with_factors(self, solve: Callable[[Array], Array]) -> FactoredLowRank:
        """Its sum with a matrix A for which ``solve`` returns A⁻¹ b (n_owned, 3)."""
        return FactoredLowRank(self, solve)


class FactoredLowRank:
    """A + G W Gᵀ with factors of A; collective.

    Attributes
    ----------
    fewer : int
        Number of negative eigenvalues that A has more than A + G W Gᵀ.
    """

    def __init__(self, low_rank: LowRank, solve: Callable[[Array], Array]) -> None:
        self._low_rank, self._solve = low_rank, solve
        self._solved = np.array([solve(vector) for vector in low_rank.vectors])
        inner = np.diag(1.0 / low_rank.weights) + np.array([low_rank._dots(u) for u in self._solved])
        self._inner = 0.5 * (inner + inner.T)
        self.fewer = int((np.linalg.eigvalsh(self._inner) < 0.0).sum())

    def solve(self, b: Array) -> Array:
        """The solution (n_owned, 3) for the right side b (n_owned, 3)."""
        x = self._solve(b)
        return np.asarray(
            x - np.tensordot(np.linalg.solve(self._inner, self._low_rank._dots(x)), self._solved, 1)
        )
