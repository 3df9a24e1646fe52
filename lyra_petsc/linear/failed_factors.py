"""A factorisation that failed is forgotten, as PETSc would report its failure ever after.

So it does for incomplete factors, MUMPS, and all that holds another solver (block Jacobi, redundant factors),
whatever the matrix becomes. MUMPS estimates its
workspace before it factors; on several ranks the order of events decides what it needs, and its margin of
20 % is not always enough (MUMPS users' guide, ICNTL(14) and INFOG(1) = -8, -9, -17, -20).
"""

from __future__ import annotations

from petsc4py import PETSc

FACTOR_TYPES = frozenset(
    {"lu", "cholesky", "ilu", "icc", "bjacobi", "asm", "gasm", "redundant", "telescope", "ksp"}
)
"""Preconditioners that options alone make again; multigrid would lose its levels."""

WORKSPACE_ERRORS = (-8, -9, -17, -20)
"""INFOG(1) where a larger ICNTL(14) helps."""

MARGIN, MORE, LARGEST = 20, 4, 2000
"""ICNTL(14) that MUMPS row_pointers with [%], the factor by which it grows, and where that ends."""


def replace_failed(ksp: PETSc.KSP) -> bool:
    """Begin anew with a solver whose preconditioner could not be set up; operators must be set again.

    Returns whether another solve may succeed with the same matrix, since MUMPS has more workspace now;
    collective.
    """
    old = ksp.getPC()
    failed = ksp.getConvergedReason() == PETSc.KSP.ConvergedReason.DIVERGED_PCSETUP_FAILED
    if not failed or old.getType() not in FACTOR_TYPES:
        return False
    larger = _enlarge_workspace(old)
    new = PETSc.PC().create(ksp.comm)
    new.setOptionsPrefix(ksp.getOptionsPrefix())
    new.setType(old.getType())
    new.setFromOptions()
    ksp.reset()
    ksp.setPC(new)
    return larger


def _enlarge_workspace(pc: PETSc.PC) -> bool:
    if pc.getType() not in ("lu", "cholesky") or pc.getFactorSolverType() != "mumps":
        return False
    factors = pc.getFactorMatrix()
    if factors.getMumpsInfog(1) not in WORKSPACE_ERRORS:
        return False
    margin = factors.getMumpsIcntl(14)
    if margin >= LARGEST:
        return False
    name = f"{factors.getOptionsPrefix() or ''}mat_mumps_icntl_14"
    PETSc.Options().setValue(name, max(MARGIN, MORE * margin))
    return True
