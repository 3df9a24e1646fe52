"""What one step of an integrator other than backward Euler can be held to.

Its stage solves M v̇ + ∇E + D v = f, and that is judged as for backward Euler: by what is left on the free
coordinates, and by what the forces within the sheet add up to. There is no identity for its energies; but
along the way of a step the elastic forces must add up to the change of the elastic energy.
"""

from __future__ import annotations

import math

import numpy as np

from lyra_petsc.experiments.stress.balance import Accountant, Balance, largest
from lyra_petsc.experiments.stress.path import EPSILON, energy, force_along
from lyra_petsc.stepping.simulation import StepReport
from lyra_petsc.terms.term import Step


class StageAccountant(Accountant):
    """Takes what balances of each step there are; collective. See `Accountant`."""

    def balance(self, report: StepReport) -> Balance:
        """The balance of the step just accepted: ``change`` is that of the elastic energy, ``bracket`` the
        integral of the elastic forces, and nothing is known of ``numerical``, ``viscous`` and ``work``."""
        system, comm = self._system, self._system.points.comm
        n, dt = system.points.n_owned, report.dt
        x0, x1 = self._x, system.x
        # targets that move stand where the step ends by now
        self._prepare(system.t0 + system.stage.after)
        parts = system.forces_at_stage()
        self._prepare(system.t1)
        total = np.asarray(sum(parts.values()))
        gap = total - self._simulation.ledger.reaction
        if not any(term.registration.moving for term in self._shell):
            # clamps push from outside, and cannot be told from the sheet's own forces here
            gap = gap - parts["internal"] - parts.get("damping", 0.0)
        free = ~system.prescribed.mask[:n]
        sums = comm.allreduce(
            np.array(
                [
                    float(np.sum(total**2, where=free)),
                    energy(self._shell, x1) - energy(self._shell, x0),
                    self._energy_roundoff(x1) + self._energy_roundoff(x0),
                    float(sum(np.abs(part).sum() for part in parts.values())),
                    float(np.sum((x1 - x0)[:n] ** 2)),
                    *gap.sum(axis=0),
                ]
            )
        )
        left, change, noise, forces, way = map(float, sums[:5])
        reach = largest(comm, x1)
        promised, floor, driving = self._promise(parts, reach)
        residual = math.sqrt(left)
        tolerance = EPSILON * (noise + forces * reach) + floor * math.sqrt(way)
        along, jumped = force_along(comm, n, self._shell, x0, x1 - x0, enough=0.1 * tolerance)
        count = system.points.n_global
        return Balance(
            energy=math.nan,
            change=change,
            numerical=0.0,
            viscous=0.0,
            bracket=along,
            work=0.0,
            defect=change - along,
            tolerance=tolerance,
            residual=residual,
            promised=promised,
            floor=floor,
            driving=driving,
            push=largest(comm, np.where(free, (x1 - x0 - dt * self._v)[:n], 0.0)),
            momentum=dt * float(np.abs(sums[5:]).max()),
            momentum_tolerance=dt * ((residual + floor) * math.sqrt(count) + EPSILON * forces),
            spin=0.0,
            spin_tolerance=0.0,
            jumped=jumped,
        )

    def _prepare(self, at: float) -> None:
        """Let moving targets stand where they are at time ``at`` [s] of the step."""
        system = self._system
        step = Step(system.t0, system.t1, at, system.x, system.reference.at)
        system.frozen |= {term: term.freeze(step) for term in system.elastic}
