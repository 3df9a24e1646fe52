"""Geometric multigrid where options ask for it: our V cycle on levels that follow a matrix."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator

from petsc4py import PETSc

from lyra_petsc.arrays import Array, Mask
from lyra_petsc.errors import InputError
from lyra_petsc.linear.hierarchy import Hierarchy
from lyra_petsc.linear.matrix import BlockMatrix
from lyra_petsc.linear.presets import PYTHON_TYPE
from lyra_petsc.linear.vcycle import VCycle

MOST_LEVELS = 20
"""Of them the fine one is one; ``-pc_mg_levels``."""


def is_asked_for() -> bool:
    """Whether options ask for our cycle: ``-pc_type mg``, or ``python`` with its name."""
    options = PETSc.Options()
    if options.getString("pc_type", "") == PETSc.PC.Type.MG:
        # PETSc's own has no levels here
        options.setValue("pc_type", PETSc.PC.Type.PYTHON)
        options.setValue("pc_python_type", PYTHON_TYPE)
    kind, name = (options.getString(key, "") for key in ("pc_type", "pc_python_type"))
    return bool(kind == PETSc.PC.Type.PYTHON and name == PYTHON_TYPE)


def most_levels() -> int:
    """What ``-pc_mg_levels`` allows."""
    return max(1, int(PETSc.Options().getInt("pc_mg_levels", MOST_LEVELS)))


class Multigrid:
    """Levels that follow ``matrix``, and the cycle of a KSP on them; collective.

    Parameters
    ----------
    matrix : BlockMatrix
    hierarchy : Hierarchy
    held : callable
        Returns the prescribed coordinates (n_local, 3) of the step.
    """

    def __init__(
        self,
        matrix: BlockMatrix,
        hierarchy: Hierarchy,
        held: Callable[[], Mask],
    ) -> None:
        self._held, self.hierarchy = held, hierarchy
        self._values: Array = matrix.rows
        self._pc: PETSc.PC | None = None
        matrix.observers.append(self._follow)

    def attach(self, ksp: PETSc.KSP) -> None:
        """Give the cycle, which PETSc made when it read the options, its levels; collective."""
        pc = ksp.getPC()
        if pc.getType() != PETSc.PC.Type.PYTHON:
            raise InputError(f"'{ksp.getType()}' takes no such preconditioner; take another", key="-ksp_type")
        self._pc = pc
        # at the end of a program that destroys nothing PETSc would call Python when that is gone
        self._at_exit = weakref.finalize(self, pc.setType, PETSc.PC.Type.NONE)
        self._cycle: VCycle = pc.getPythonContext()
        self._cycle.attach(self.hierarchy, self._renew)

    def _follow(self, values: Array) -> None:
        self._values = values
        self.hierarchy.rows_changed()

    def _renew(self) -> Iterator[tuple[Array, Array]]:
        """Block rows of all levels for the matrix as it is now; collective."""
        return self.hierarchy.block_rows(self._values, self._held())

    def destroy(self, *, for_good: bool) -> None:
        """Free the levels; collective. Unless it is for good, the PC will be given others."""
        if self._pc is not None:
            if for_good:
                self._at_exit()  # others may hold the PC until PETSc ends
            else:
                self._at_exit.detach()
                self._cycle.detach()
        self.hierarchy.destroy()
