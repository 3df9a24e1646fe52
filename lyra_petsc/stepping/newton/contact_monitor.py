"""The monitor ``-contact_monitor``: contact and friction at each Newton iterate."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from lyra_petsc.contact.barrier import ContactBarrier
from lyra_petsc.contact.friction import CoulombFriction
from lyra_petsc.stepping.stage_equations import StageEquations


class ContactMonitor:
    """Prints a line for each iterate of one SNES, below those of ``-snes_monitor``.

    It has the number of contacts, the smallest gap [m], the stiffness [N/m] of the stiffest contact, and the
    fraction of the last Newton step that collision detection allowed. With friction also the numbers of
    sticking and sliding pairs, and the sums of the normal forces [N] that friction takes (those at the start
    of the step) and of those at the iterate.

    Parameters
    ----------
    system : StageEquations
        System of a scene with contact.
    step_fraction : callable
        Returns the fraction of the last Newton step that was allowed.
    """

    def __init__(self, system: StageEquations, step_fraction: Callable[[], float]) -> None:
        self._system, self._step_fraction = system, step_fraction
        near = system.active.changing
        self._contact = next(term for term in near if isinstance(term, ContactBarrier))
        self._friction = next((term for term in near if isinstance(term, CoulombFriction)), None)

    def __call__(self, snes: PETSc.SNES, number: int, norm: float) -> None:
        """For ``SNES.setMonitor``; collective."""
        system, contact = self._system, self._contact
        v = snes.getSolution().getArray(readonly=True).reshape(-1, 3)
        x, _ = system.evaluate_at(v)
        frozen = system.active.frozen[contact]
        here, stiffest = contact.history(x, frozen), contact.largest_stiffness(x, frozen)
        sums = [here["contacts"]]
        if self._friction is not None:
            sums += self._friction.count_sticking(x, system.active.frozen[self._friction])
            sums.append(float(contact.find_contacts(x, frozen.stage, contact.n_owned)[2].sum()))
        sums = system.points.global_sum(*sums).tolist()
        extremes = np.array([stiffest, -here["smallest_gap"]])
        system.points.comm.Allreduce(MPI.IN_PLACE, extremes, MPI.MAX)
        line = f"{number:3d} CONTACT {sums[0]:.0f} contacts, "
        if sums[0] > 0.0:
            line += f"smallest gap {-extremes[1]:.6e} m, stiffest {extremes[0]:.6e} N/m, "
        line += f"step limit {self._step_fraction():.4g}"
        if self._friction is not None:
            stick, slide, taken, now = sums[1:]
            line += f"; friction: {stick:.0f} stick, {slide:.0f} slide, "
            line += f"normal forces {taken:.6e} N, now {now:.6e} N"
        PETSc.Sys.Print(" " * snes.getTabLevel() + line, comm=system.points.comm)
