"""Stiffness-proportional damping D = Σ γ K⁺ over the elements, with the geometry frozen during a step."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.linear.block_rows import BlockRows
from lyra_petsc.linear.discretisation import Discretisation
from lyra_petsc.terms.term import Elastic, Term


class ScaledDamping:
    """Products with D from block rows that hold factor · D + diagonal · I.

    The caller may afterwards overwrite some values, for prescribed unknowns, of which a copy is kept.

    Parameters
    ----------
    values : (n_stored, 3, 3)
        The block rows; not copied.
    factor : float
    diagonal : (n_owned,)
    changing : (n,) int
        Flat indices of the values that may be overwritten.
    """

    def __init__(self, values: Array, factor: float, diagonal: Array, changing: NDArray[np.int64]) -> None:
        self._values, self._factor, self._diagonal = values, factor, diagonal
        self._flat = values.reshape(-1)
        self._changing, self._kept = changing, self._flat[changing]

    def product(self, blocks: BlockRows, v: Array) -> Array:
        """D v (n_owned, 3) for v (n_local, 3)."""
        now = self._flat[self._changing]
        self._flat[self._changing] = self._kept
        out = blocks.product(self._values, v)
        self._flat[self._changing] = now
        out -= self._diagonal[:, None] * v[: len(out)]
        out /= self._factor
        return out


class Damping:
    """The owned rows of D, from the regularised Hessians K⁺ of the damped terms.

    Parameters
    ----------
    discretisation : Discretisation
    elastic : sequence of Elastic
        All elastic terms of the scene; those without damping are ignored.
    dynamic : bool
        Whether the scene is a motion; in a static analysis nothing is damped.
    single_assembly : bool
        Whether the matrix is assembled only once in a step, and kept until its end.

    Attributes
    ----------
    active : bool
        Whether any term is damped, on any rank; if not, nothing is stored.
    frozen : mapping of Term → any
        Frozen data of the terms at the start of the step, before frames of edges were updated.
    """

    def __init__(
        self,
        discretisation: Discretisation,
        elastic: Sequence[Elastic],
        *,
        dynamic: bool,
        single_assembly: bool,
    ) -> None:
        self._discretisation, self._single_assembly = discretisation, single_assembly
        self._terms = [
            t for t in elastic if dynamic and t.registration.damped and np.any(t.elements.data["damping"])
        ]
        self.active = bool(discretisation.layout.comm.allreduce(len(self._terms), MPI.MAX))
        self._values: Array | None = None
        self._stored = False
        self._multiple: ScaledDamping | None = None
        self._x: Array | None = None
        self.frozen: Mapping[Term, Any] = {}
        self._located: Mapping[Term, Any] = {}
        factors = np.concatenate([np.empty(0), *(t.elements.data["damping"] for t in self._terms)])
        uniform = len(factors) > 0 and factors.min() == factors.max()
        self._gamma = float(factors[0]) if uniform else 0.0
        self._undamped = [term for term in elastic if term not in self._terms]

    @property
    def _blocks(self) -> BlockRows:
        """The block rows of fixed stencils; all damped terms have such stencils."""
        return self._discretisation.fixed

    def freeze(self, x: Array, frozen: Mapping[Term, Any], located: Mapping[Term, Any]) -> None:
        """Set the geometry to positions x (n_local, 3), not copied, with the terms' frozen data, and these
        with what is known of the geometry there.
        """
        self.release_values()
        self._x, self._stored, self.frozen, self._located = x, False, frozen, located
        if not self._single_assembly:
            self._stored_values()
            self._located = frozen  # frees the memory of the geometry

    def release_values(self) -> None:
        """Stop using the block rows that `assemble_with_stiffness` was given."""
        self._multiple = None

    def _add(self, x: Array, weight: Callable[[Elastic], Array | float], values: Array) -> None:
        for term in self._terms:
            self._blocks.add_stiffness(term, x, self._located[term], 1.0, weight(term), values)

    def _stored_values(self) -> Array:
        """Values of D, assembled at the first call after a change of the geometry."""
        if self._values is None:
            self._values = self._blocks.zeros()
        if not self._stored and self._x is not None:
            self._values[:] = 0.0
            self._add(self._x, lambda term: term.elements.data["damping"], self._values)
            self._stored = True
        return self._values

    def product(self, v: Array) -> Array:
        """D v (n_owned, 3) [N] for velocities v (n_local, 3)."""
        if not v.any():  # for example in the residual of a semi-implicit step
            return np.zeros((self._discretisation.layout.n_owned, 3))
        if self._multiple is not None:
            return self._multiple.product(self._blocks, v)
        return self._blocks.product(self._stored_values(), v)

    def product_at(self, x: Array, v: Array) -> Array:
        """D v with the geometry of positions x (n_local, 3), instead of the geometry of the step."""
        kept = self._x, self._located
        self._x, self._located, self._stored = x, self.frozen, False
        out = self._blocks.product(self._stored_values(), v)
        (self._x, self._located), self._stored = kept, False
        return out

    def assemble(self, values: Array, diagonal: Array) -> None:
        """Write D + ``diagonal`` (n_owned,) · I to ``values`` (n_stored, 3, 3)."""
        self.release_values()
        rows, positions = self._discretisation.rows, self._discretisation.fixed_positions
        if self.active and positions is None:
            rows.scale(self._stored_values(), 1.0, diagonal, values)
        else:
            rows.set_diagonal(diagonal, values)
            if self.active and positions is not None:
                rows.add_blocks(self._stored_values(), positions, values)

    def assemble_with_stiffness(
        self, weight: float, diagonal: Array, values: Array, changing: NDArray[np.int64]
    ) -> bool:
        """Write D + weight · K⁺ + ``diagonal`` (n_owned,) · I to ``values``, if K⁺ is a multiple of D.

        K⁺ is that of the frozen geometry; it is a multiple of D if all elements have the same γ. This halves
        the assembly of a semi-implicit step, and D need not be stored. Returns False, and writes nothing, in
        other cases. The caller may afterwards overwrite ``values`` at the flat indices ``changing`` (n,).
        """
        self.release_values()
        other = self._discretisation.fixed_positions is not None or any(
            term.n_elements for term in self._undamped
        )
        if not self._gamma or other or self._x is None:
            return False
        factor = 1.0 + weight / self._gamma
        if self._single_assembly and not self._stored:
            self._blocks.set_diagonal(diagonal, values)
            self._add(self._x, lambda term: self._gamma + weight, values)
            self._multiple = ScaledDamping(values, factor, diagonal, changing)
        else:
            self._blocks.scale(self._stored_values(), factor, diagonal, values)
        return True
