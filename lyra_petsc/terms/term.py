"""What every term offers: pure functions on arrays. It knows neither PETSc, MPI nor files.

Arrays over the points of a rank (owned first, then ghosts) have shape (n_local, 3). Gradients are
added to all points of a stencil; what lands on ghosts is never read, since each rank has every
element that touches a point it owns.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.partition.elements import Elements

Array = NDArray[np.float64]
Offsets = NDArray[np.int32] | NDArray[np.int64]
Couplings = Mapping[str, NDArray[np.int32]]


class Term(ABC):
    """A sum over elements; ``name`` as in the registry."""

    name: ClassVar[str]

    def __init__(self, elements: Elements) -> None:
        self.elements = elements.once("damping")
        self.stencil = np.ascontiguousarray(elements.stencil, dtype=np.int32)
        self.n_elements = len(self.stencil)
        self.n_owned = elements.n_owned

    @property
    def couplings(self) -> Couplings:
        """Stencils (E, n) whose points the Hessians couple, by the names of their offsets in a pattern."""
        return {self.name: self.stencil}

    def offsets_of_elements(self, offsets: Mapping[str, Offsets]) -> Offsets:
        """Where in block rows the ``hessians`` go, (E, n (n + 1) / 2)."""
        return offsets[self.name]


class Elastic(Term):
    """An energy of the positions; its force is minus the gradient."""

    #: whether stiffness-proportional damping acts through this term
    damped: ClassVar[bool] = True

    @abstractmethod
    def energies(self, x: Array) -> Array:
        """Energy [J] of each owned element, (n_owned,)."""

    @abstractmethod
    def add_gradient(self, x: Array, out: Array) -> None:
        """Add the gradient [N] to ``out`` (n_local, 3)."""

    @abstractmethod
    def hessians(self, x: Array, lo: int, hi: int, blend: float, out: Array) -> None:
        """Hessian blocks [N/m] of elements lo..hi into ``out`` (hi − lo, n, n, 3, 3).

        ``blend`` 0 gives the exact one, 1 the regularised, positive-semidefinite one.
        """

    def add_hessians(
        self, x: Array, blend: float, weight: Array, offsets: Mapping[str, Offsets], values: Array
    ) -> bool:
        """Add weight (E,) × Hessian blocks [N/m] to block rows (n_blocks, 3, 3) at once; whether it did.

        ``offsets`` are a pattern's, by the names of ``couplings``. What a term cannot add so goes by
        ``hessians`` and ``offsets_of_elements``.
        """
        return False

    @abstractmethod
    def force_scale(self, size: float) -> Array:
        """Force [N] whose relative round-off each element's force carries, (E,).

        ``size`` [m] is the largest coordinate, to which it is proportional.
        """

    def linearise_from(self, y: Array | None) -> None:
        """Let exact Hessians at x have the stress that y's linearised strain predicts there; None: x's own.

        ``y`` (n_local, 3) is the Newton iterate before x.
        """

    def begin(self, time: float, x: Array) -> None:
        """Take the shape x (n_local, 3) from which what starts to act at ``time`` [s] sets out."""

    def prepare(self, t0: float, t1: float, at: float) -> None:
        """Let moving targets stand where they are at time ``at`` of the step from t0 to t1 [s]."""


class Pulling(Elastic):
    """An elastic term by which handles pull."""

    @abstractmethod
    def handle_forces(self, x: Array, count: int) -> Array:
        """Force [N] of each of a scene's handles on this rank's elements, (count, 3)."""


class Viscous(Term):
    """A potential of the velocities, with the geometry frozen at the start of the step."""

    @abstractmethod
    def freeze(self, x: Array, v: Array) -> None:
        """Take the geometry from the positions (n_local, 3) at the start of the step."""

    @abstractmethod
    def potentials(self, v: Array) -> Array:
        """Potential [W] of each owned element, (n_owned,); its gradient is minus the force."""

    @abstractmethod
    def add_gradient(self, v: Array, out: Array) -> None:
        """Add the gradient with respect to velocity [N] to ``out``."""

    @abstractmethod
    def hessians(self, v: Array, lo: int, hi: int, out: Array) -> None:
        """Hessian blocks [N s/m] with respect to velocity into ``out`` (hi − lo, n, n, 3, 3)."""

    def add_hessians(self, v: Array, offsets: Mapping[str, Offsets], values: Array) -> bool:
        """Add Hessian blocks [N s/m] to block rows as `Elastic.add_hessians` does; whether it did."""
        return False


class Load(Term):
    """A force that does not change within a step."""

    #: whether it depends on the positions at the start of the step
    follows: ClassVar[bool] = False

    @abstractmethod
    def add_force(self, x: Array, t0: float, t1: float, out: Array) -> None:
        """Add the force [N] of the step from t0 to t1 [s] that starts at positions x to ``out``."""

    def potential(self, x: Array) -> float:
        """Potential energy [J] of this rank's elements where the load has one, else 0."""
        return 0.0
