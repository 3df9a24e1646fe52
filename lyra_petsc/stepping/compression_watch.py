"""Warning of compression at which the membrane model itself softens."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from lyra_petsc.stepping.problem import Problem
from lyra_petsc.terms.stretch import SOFTENS_BELOW, principal_stretches


class CompressionWatch:
    """Monitors the principal stretches of a problem; collective.

    Parameters
    ----------
    problem : Problem

    Attributes
    ----------
    smallest, largest : float
        Extreme principal stretches of the last state checked; 1 before the first.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self.smallest = self.largest = 1.0

    def check(self, when: str, *, reported: bool) -> str | None:
        """Measure the present state; the warning, if there is one and it has not been ``reported`` before.

        ``when`` is the text that names the state.
        """
        membrane, comm = self._problem.membrane, self._problem.points.comm
        n = membrane.n_owned
        stretches = principal_stretches(
            self._problem.equations.x, membrane.stencil, membrane.elements.data["inverse"], n
        )
        local = (stretches[:, 0].min(), stretches[:, 1].max()) if n else (np.inf, -np.inf)
        opposite, self.largest = self._problem.points.global_max(-float(local[0]), float(local[1]))
        self.smallest = -opposite
        if reported or not membrane.softens or not self.smallest < SOFTENS_BELOW:
            return None
        mine = n > 0 and local[0] == self.smallest
        index = int(membrane.elements.index[np.argmin(stretches[:, 0])]) if mine else np.iinfo(np.int64).max
        triangle = comm.allreduce(index, MPI.MIN)
        return (
            f"{when}: triangle {triangle} (counted from 0, in the mesh's order) is compressed to "
            f"{self.smallest:.3g} of its length; below {SOFTENS_BELOW:.3f} the St. Venant-Kirchhoff model "
            "softens under further compression, where a real sheet would buckle: a finer mesh lets it, "
            "more bending stiffness or a smaller load avoids it"
        )
