"""The monitor ``-contact_monitor``: contact and friction at each Newton iterate."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.contact.scene_contact import Frozen, SceneContact


class ContactMonitor:
    """Prints a line for each iterate of one SNES, below those of ``-snes_monitor``.

    It has the number of contacts, the smallest gap [m], the stiffness [N/m] of the stiffest contact, and the
    fraction of the last Newton step that collision detection allowed. With friction also the numbers of
    sticking and sliding pairs, and the sums of the normal forces [N] that friction takes (those at the start
    of the step) and of those at the iterate.

    Parameters
    ----------
    contact : SceneContact
    evaluate : callable
        Returns the positions (n_local, 3) of the stage at velocities (n_owned, 3), and the frozen data.
    step_fraction : callable
        Returns the fraction of the last Newton step that was allowed.
    """

    def __init__(
        self,
        contact: SceneContact,
        evaluate: Callable[[Array], tuple[Array, Frozen]],
        step_fraction: Callable[[], float],
    ) -> None:
        self._contact, self._evaluate, self._step_fraction = contact, evaluate, step_fraction

    def __call__(self, snes: PETSc.SNES, number: int, norm: float) -> None:
        """For ``SNES.setMonitor``; collective."""
        barrier, friction, layout = self._contact.barrier, self._contact.friction, self._contact.layout
        x, frozen = self._evaluate(snes.getSolution().getArray(readonly=True).reshape(-1, 3))
        obstacles = frozen[barrier]
        here, stiffest = barrier.history(x, obstacles), barrier.largest_stiffness(x, obstacles)
        sums = [here["contacts"]]
        if friction is not None:
            sums += friction.count_sticking(x, frozen[friction])
            sums.append(float(barrier.find_contacts(x, obstacles.stage).force.sum()))
        sums = layout.global_sum(*sums).tolist()
        extremes = np.array([stiffest, -here["smallest_gap"]])
        layout.comm.Allreduce(MPI.IN_PLACE, extremes, MPI.MAX)
        line = f"{number:3d} CONTACT {sums[0]:.0f} contacts, "
        if sums[0] > 0.0:
            line += f"smallest gap {-extremes[1]:.6e} m, stiffest {extremes[0]:.6e} N/m, "
        line += f"step limit {self._step_fraction():.4g}"
        if friction is not None:
            stick, slide, taken, now = sums[1:]
            line += f"; friction: {stick:.0f} stick, {slide:.0f} slide, "
            line += f"normal forces {taken:.6e} N, now {now:.6e} N"
        PETSc.Sys.Print(" " * snes.getTabLevel() + line, comm=layout.comm)
