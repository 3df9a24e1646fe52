"""Stiffness-proportional damping D = Σ γ K⁺ over the elements, with the geometry frozen during a step."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.assembly.blocks import BlockRows
from lyra_petsc.partition.points import Points
from lyra_petsc.stepping.remembered import Remembered
from lyra_petsc.terms.term import Elastic

Array = NDArray[np.float64]


class Damping:
    """D of the owned rows, from the regularised Hessians K⁺ of the damped terms.

    Parameters
    ----------
    points : Points
    blocks : BlockRows
    elastic : sequence of Elastic
        All of the scene; those without damping are passed over.
    moves : bool
        Nothing is damped where time does not pass.

    Attributes
    ----------
    acts : bool
        Whether anything is damped, on any rank; without, nothing is stored.
    product : Remembered
        D v, owned rows (n_owned, 3) [N], of velocities v (n_local, 3).
    """

    def __init__(self, points: Points, blocks: BlockRows, elastic: Sequence[Elastic], *, moves: bool) -> None:
        self._points, self._blocks = points, blocks
        self._terms = [t for t in elastic if moves and t.damped and np.any(t.elements.data["damping"])]
        self.acts = bool(points.comm.allreduce(len(self._terms), MPI.MAX))
        self._values = blocks.zeros() if self.acts else None
        self._at: Array | None = None
        # residual, objective and works ask at the same velocities
        self.product = Remembered(self._product)
        factors = np.concatenate([np.empty(0), *(t.elements.data["damping"] for t in self._terms)])
        uniform = len(factors) > 0 and factors.min() == factors.max() and len(self._terms) == len(elastic)
        self._gamma = float(factors[0]) if uniform else 0.0

    def freeze(self, x: Array) -> None:
        """Take the geometry of positions x (n_local, 3)."""
        assert self._values is not None
        self._values[:] = 0.0
        self._at = x.copy()
        self.product.forget()
        for term in self._terms:
            self._blocks.add_stiffness(term, x, 1.0, term.elements.data["damping"], self._values)

    def _product(self, v: Array) -> Array:
        assert self._values is not None
        if not v.any():  # as where a semi-implicit step looks at its forces
            return np.zeros((self._points.n_owned, 3))
        return self._blocks.product(self._values, v)

    def into(self, values: Array) -> None:
        """Let ``values`` (n_blocks, 3, 3) be D."""
        values[:] = 0.0 if self._values is None else self._values

    def with_stiffness_into(self, x: Array, weight: float, diagonal: Array, values: Array) -> bool:
        """Let ``values`` be D + weight · K⁺(x) + ``diagonal`` (n_owned,) · I, if K⁺ is a multiple of D.

        It is where all elements have one γ, and D was frozen at x: half the assembly of a semi-implicit step.
        Else False.
        """
        if self._values is None or not self._gamma or self._at is None or not np.array_equal(x, self._at):
            return False
        self._blocks.scale(self._values, 1.0 + weight / self._gamma, diagonal, values)
        return True
