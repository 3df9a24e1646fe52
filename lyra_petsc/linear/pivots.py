"""Whether negative curvature of a matrix is detected with a given preconditioner built from that matrix.

With a preconditioner that only approximates the matrix conjugate gradients detect it. With exact factors the
solve ends after one iteration whatever the signs of the eigenvalues, and only the pivots show them.
"""

from __future__ import annotations

from petsc4py import PETSc

APPROXIMATE = frozenset({"none", "jacobi", "pbjacobi", "sor", "ilu", "icc", "gamg", "mg", "python"})
"""Preconditioners with which conjugate gradients detect negative curvature."""


def shows_negative_curvature(pc: PETSc.PC) -> bool:
    """Whether negative curvature is detected, by conjugate gradients or by ``negative_pivots``."""
    return _local_type(pc) in APPROXIMATE or _counts_pivots(pc)


def is_incomplete(pc: PETSc.PC) -> bool:
    """Whether the preconditioner is an incomplete factorisation, also of each rank's block."""
    return _local_type(pc) in ("ilu", "icc")


def _local_type(pc: PETSc.PC) -> str:
    """Type of the preconditioner, or with block Jacobi that of its blocks."""
    if pc.getType() == "bjacobi":
        return str(PETSc.Options().getString("sub_pc_type", "ilu"))
    return str(pc.getType())


def negative_pivots(pc: PETSc.PC) -> int:
    """Number of negative pivots, by Sylvester's law of inertia that of negative eigenvalues; collective.

    0 if the preconditioner does not count pivots.
    """
    return int(pc.getFactorMatrix().getMumpsInfog(12)) if _counts_pivots(pc) else 0


def _counts_pivots(pc: PETSc.PC) -> bool:
    return bool(pc.getType() == "cholesky" and pc.getFactorSolverType() == "mumps")
