"""The out-of-balance force of a sheet, and whether it counts as zero."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array
from lyra_petsc.stepping.newton.force_scales import limit_roundoff
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.statics.load_step_progress import PROGRESS


class ForceBalance:
    """Out-of-balance forces of a sheet; collective.

    Parameters
    ----------
    equations : StageEquations
    tolerance : float
        Force that counts as zero, over the largest part of the forces.
    floor : float
        Norm [N] of the residual's round-off.

    Attributes
    ----------
    scale : float
        Norm [N] of the largest part of the forces in all equilibria found. Not that on the way to them: in a
        snap it may be 1e5 times as large.
    """

    def __init__(self, equations: StageEquations, tolerance: float, floor: float) -> None:
        self._equations, self._tolerance, self._floor, self.scale = equations, tolerance, floor, 0.0

    def norm(self, vector: Array) -> float:
        """Norm over all ranks of a vector (n_owned, 3)."""
        return float(np.sqrt(self._equations.points.comm.allreduce(float(np.vdot(vector, vector)))))

    def at_start(self, before: float, factor: float) -> tuple[float, float]:
        """Begin a step between two load factors at the present positions.

        Returns the norm [N] of the out-of-balance force, and the largest acceleration [m/s²] by it.
        """
        equations = self._equations
        equations.begin_step(before, factor)
        force = equations.out_of_balance()
        norm = self.norm(force)
        if not np.isfinite(norm):  # an obstacle has moved into the sheet
            return norm, 0.0
        n = equations.points.n_vertices
        fastest = float(np.abs(force[:n] / equations.mass[:n, None]).max(initial=0.0))
        if equations.points.n_edges_global:  # loads may act on edges alone, which have no mass
            mass = equations.points.global_sum(float(equations.mass.sum()))[0]
            mass /= equations.points.n_vertices_global
            fastest = max(fastest, float(np.abs(force[n:]).max(initial=0.0)) / mass)
        return norm, equations.points.comm.allreduce(fastest, MPI.MAX)

    def record(self) -> None:
        """Note that the forces last computed are those of an equilibrium."""
        self.scale = self._largest()

    def _largest(self) -> float:
        return max(self.scale, self._equations.forces.largest_force())

    def is_zero(self, force: float, last: float) -> bool:
        """Whether a force of this norm [N] counts as zero; ``last`` [N] is that one proximal step before.

        Below the round-off floor proximal steps are taken as long as they reduce the force.
        """
        if force <= self._tolerance * self._largest():
            return True
        return PROGRESS * last <= force <= max(self._floor, limit_roundoff(self._equations.evaluated))
