"""Whether a preconditioner that is built from the very matrix it is for lets negative curvature be seen.

Conjugate gradients meet it with a preconditioner that only resembles the matrix. Exact factors are the
matrix: the solve ends after an iteration, whatever its signs, and only their pivots tell.
"""

from __future__ import annotations

from petsc4py import PETSc

RESEMBLING = frozenset({"none", "jacobi", "pbjacobi", "sor", "ilu", "icc", "gamg", "mg", "python"})
"""Preconditioners that leave conjugate gradients something to find."""


def shows_negative_curvature(pc: PETSc.PC) -> bool:
    """Whether it would be noticed, by conjugate gradients or by ``negative_pivots``."""
    return _kind(pc) in RESEMBLING or _counts_pivots(pc)


def is_incomplete(pc: PETSc.PC) -> bool:
    """Whether it is made of incomplete factors."""
    return _kind(pc) in ("ilu", "icc")


def _kind(pc: PETSc.PC) -> str:
    """Its type, or that of its blocks."""
    if pc.getType() == "bjacobi":
        return str(PETSc.Options().getString("sub_pc_type", "ilu"))
    return str(pc.getType())


def negative_pivots(pc: PETSc.PC) -> int:
    """Negative pivots of the factors in use, by Sylvester's law the matrix's negative eigenvalues.

    0 for what has no factors; collective.
    """
    return int(pc.getFactorMatrix().getMumpsInfog(12)) if _counts_pivots(pc) else 0


def _counts_pivots(pc: PETSc.PC) -> bool:
    return bool(pc.getType() == "cholesky" and pc.getFactorSolverType() == "mumps")
