"""Geometric multigrid as a PC: connects the V cycle of ``vcycle`` with a matrix and its coarse levels."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator

from petsc4py import PETSc

from lyra_petsc.arrays import Array, Mask
from lyra_petsc.errors import InputError
from lyra_petsc.linear.hierarchy import Hierarchy
from lyra_petsc.linear.matrix import BlockMatrix
from lyra_petsc.linear.pattern import LARGEST_INT32
from lyra_petsc.linear.presets import PYTHON_TYPE
from lyra_petsc.linear.vcycle import VCycle


def is_requested() -> bool:
    """Whether options choose this multigrid: ``-pc_type mg``, or ``python`` with the class of its cycle."""
    options = PETSc.Options()
    if options.getString("pc_type", "") == PETSc.PC.Type.MG:
        # PETSc's own PCMG would have no levels
        options.setValue("pc_type", PETSc.PC.Type.PYTHON)
        options.setValue("pc_python_type", PYTHON_TYPE)
    kind, name = (options.getString(key, "") for key in ("pc_type", "pc_python_type"))
    return bool(kind == PETSc.PC.Type.PYTHON and name == PYTHON_TYPE)


def max_levels() -> int:
    """The largest number of levels, ``-pc_mg_levels``, with the finest; otherwise as many as there are."""
    return max(1, int(PETSc.Options().getInt("pc_mg_levels", LARGEST_INT32)))


class Multigrid:
    """Levels that are updated with ``matrix``, and the cycle of a KSP on them; collective.

    Parameters
    ----------
    matrix : BlockMatrix
    hierarchy : Hierarchy
    held : callable
        Returns the mask (n_local, 3) of the step's prescribed coordinates.
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
        """Give the levels to the cycle that PETSc created from the options; collective."""
        pc = ksp.getPC()
        if pc.getType() != PETSc.PC.Type.PYTHON:
            raise InputError(f"'{ksp.getType()}' takes no such preconditioner; take another", key="-ksp_type")
        self._pc = pc
        # if a program destroys nothing, PETSc's finalisation would call Python after its end
        self._at_exit = weakref.finalize(self, pc.setType, PETSc.PC.Type.NONE)
        self._cycle: VCycle = pc.getPythonContext()
        self._cycle.attach(self.hierarchy, self._renew)

    def _follow(self, values: Array) -> None:
        self._values = values
        self.hierarchy.rows_changed()

    def _renew(self) -> Iterator[tuple[Array, Array]]:
        """Block rows of all levels for the current matrix; collective."""
        return self.hierarchy.block_rows(self._values, self._held())

    def destroy(self, *, for_good: bool) -> None:
        """Free the levels; collective. Unless ``for_good``, the PC will get other levels."""
        if self._pc is not None:
            if for_good:
                self._at_exit()  # other objects may keep the PC until PETSc's finalisation
            else:
                self._at_exit.detach()
                self._cycle.detach()
        self.hierarchy.destroy()
