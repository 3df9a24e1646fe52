"""By how much diagonal blocks are enlarged before a matrix is factored incompletely.

Incomplete factors of a positive-definite matrix may be indefinite. Those of one with a larger diagonal exist,
and resemble the matrix less (Manteuffel, Math. Comp. 34, 1980, 473-497).
"""

from __future__ import annotations

from collections.abc import Mapping

from petsc4py import PETSc

from lyra_petsc.linear.pivots import is_incomplete

LEAST, LARGEST = 0.01, 1.0
"""Fractions of the diagonal blocks."""

MORE, LESS = 4.0, 0.9
"""Factors after indefinite factors, and from step to step."""

INDEFINITE = (
    PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_PC,
    PETSc.KSP.ConvergedReason.DIVERGED_PCSETUP_FAILED,
)


class DiagonalShift:
    """Enlarges as little as makes the factors of a KSP's preconditioner positive definite.

    Parameters
    ----------
    ksp : PETSc.KSP
    acts : bool
        The preconditioner is built from a matrix of its own.
    """

    def __init__(self, ksp: PETSc.KSP, *, acts: bool) -> None:
        self._ksp, self._acts = ksp, acts
        self._value = LEAST

    @property
    def value(self) -> float:
        """Fraction by which diagonal blocks are to be larger; 0 where nothing is factored incompletely."""
        return self._value if self._acts and is_incomplete(self._ksp.getPC()) else 0.0

    def memory(self) -> dict[str, float]:
        """What a checkpoint must hold to go on alike."""
        return {"shift": self._value}

    def restore(self, memory: Mapping[str, float]) -> None:
        """Go on with a memory."""
        self._value = float(memory.get("shift", self._value))

    def begin(self) -> None:
        """A new step: a little less than in the last one."""
        self._value = max(LEAST, LESS * self._value)

    def raise_(self) -> bool:
        """Take more if the last solve failed by the factors; whether that may help."""
        failed = self._ksp.getConvergedReason() in INDEFINITE
        if not failed or self.value == 0.0 or self._value >= LARGEST:
            return False
        self._value = min(LARGEST, MORE * self._value)
        return True
