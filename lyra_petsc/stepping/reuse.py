"""For how many steps a preconditioner serves, where a step is one linear solve (``semi-implicit``).

Setting it up costs as much as some linear iterations. It is kept until a solve takes more iterations than
the solves with it took on average, its set-up counted in: from there on the average would grow. After that
the next step sets it up anew, as it does where the time step or the prescribed unknowns are others.
"""

from __future__ import annotations

from lyra_petsc.stepping.stage_equations import StageEquations

SET_UP = 8.0
"""Set-up of a preconditioner in linear iterations; incomplete factors take about ten, block Jacobi fewer."""

SAME_STEP = 1.25
"""Factor by which the time step may differ."""


class Reuse:
    """Decides from numbers of iterations, the same on all ranks.

    Parameters
    ----------
    acts : bool
        Else every solve sets up its own.

    Attributes
    ----------
    reused : bool
        The last solve took one of a step before.
    """

    def __init__(self, *, acts: bool) -> None:
        self._acts = acts
        self._for: tuple[float, object] | None = None
        self.reused = False
        self.renew()

    def renew(self) -> None:
        """Let the next solve set up its own preconditioner."""
        self._solves, self._iterations = 0, SET_UP

    def begin(self, equations: StageEquations) -> bool:
        """Whether the next solve can do with the preconditioner that there is."""
        reach, mask = equations.stage.reach, equations.prescribed.mask
        if self._for is None or self._for[1] is not mask or not _alike(reach, self._for[0]):
            self.renew()
        self.reused = self._acts and self._solves > 0
        if not self.reused:
            self._for = reach, mask
        return self.reused

    def solved(self, iterations: int) -> None:
        """A solve took so many linear iterations."""
        self._solves += 1
        self._iterations += iterations
        if iterations * self._solves > self._iterations:
            self.renew()


def _alike(step: float, other: float) -> bool:
    return other / SAME_STEP < step < other * SAME_STEP
