"""Geometric multigrid where options ask for it: our V cycle or PETSc's, on levels that follow a matrix."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from lyra_petsc.assembly.matrix import SystemMatrix
from lyra_petsc.assembly.pattern import BlockPattern
from lyra_petsc.partition.points import Points
from lyra_petsc.solvers.hierarchy import Hierarchy, Surface
from lyra_petsc.solvers.options import shows_no_matrix
from lyra_petsc.solvers.pcmg import PetscCycle
from lyra_petsc.solvers.presets import CONJUGATE_GRADIENTS, PYTHON_TYPE
from lyra_petsc.solvers.vcycle import VCycle

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MOST_LEVELS = 20
"""Of them the fine one is one; ``-pc_mg_levels``."""


def kind_asked_for() -> str:
    """``mg`` for PETSc's cycle, ``python`` for ours, or nothing."""
    options = PETSc.Options()
    kind = str(options.getString("pc_type", ""))
    if kind == PETSc.PC.Type.PYTHON and options.getString("pc_python_type", "") == PYTHON_TYPE:
        return kind
    return kind if kind == PETSc.PC.Type.MG else ""


class Multigrid:
    """Levels that follow ``matrix``, and the cycle of ``ksp`` on them; collective.

    Parameters
    ----------
    ksp : PETSc.KSP
        Before its options are read.
    matrix : SystemMatrix
    points : Points
    pattern : BlockPattern
    surface : Surface
    held : callable
        Returns the prescribed coordinates (n_local, 3) of the step.
    """

    def __init__(
        self,
        ksp: PETSc.KSP,
        matrix: SystemMatrix,
        points: Points,
        pattern: BlockPattern,
        surface: Surface,
        held: Callable[[], Mask],
    ) -> None:
        self._held, self._matrix = held, matrix
        ours = kind_asked_for() == PETSc.PC.Type.PYTHON
        least = 1 if ours else 2
        most = max(least, PETSc.Options().getInt("pc_mg_levels", MOST_LEVELS))
        self.hierarchy = Hierarchy(points, pattern, surface, most)
        self._values: Array | None = None
        self._cycle: VCycle | PetscCycle | None = None
        if not ours:
            self._cycle = PetscCycle(ksp.getPC(), self.hierarchy)
        matrix.followers.append(self._follow)

    def after_options(self, ksp: PETSc.KSP, operator: SystemMatrix) -> None:
        """Give our cycle, which PETSc makes when it reads the options, its levels; collective."""
        if self._cycle is None:
            multiplies_only = ksp.getType() in CONJUGATE_GRADIENTS and operator.multiplies_rows
            if multiplies_only and shows_no_matrix():
                operator.unread()
            if self._matrix is not operator:
                self._matrix.unread()
            pc = ksp.getPC()
            context: VCycle = pc.getPythonContext()
            context.attach(self.hierarchy, self._renew)
            self._cycle = context
            # at the end of a program that destroys nothing PETSc would call Python when that is gone
            self._detach = weakref.finalize(self, pc.setType, PETSc.PC.Type.NONE)

    def _follow(self, values: Array) -> None:
        self._values = values
        if isinstance(self._cycle, PetscCycle):  # ours asks for them when PETSc sets it up
            self._cycle.update(self._renew())

    def _renew(self) -> Iterator[tuple[Array, Array]]:
        """Block rows of all levels for the matrix as it is now; collective."""
        assert self._values is not None
        return self.hierarchy.block_rows(self._values, self._held())

    def destroy(self) -> None:
        """Free the PETSc objects; collective."""
        if isinstance(self._cycle, PetscCycle):
            self._cycle.destroy()
        elif self._cycle is not None:
            self._detach()
        self.hierarchy.destroy()
