"""Replacement of a PC whose factorisation failed, since PETSc keeps reporting the failure for new matrices.

This holds for incomplete factors, MUMPS, and preconditioners with inner solvers (block Jacobi, redundant).
MUMPS estimates its workspace before it factors; on several ranks the amount needed depends on the order of
events, and its margin of 20 % is not always enough (MUMPS users' guide, ICNTL(14) and INFOG(1) = -8, -9, -17,
-20).
"""

from __future__ import annotations

from petsc4py import PETSc

FACTOR_TYPES = frozenset(
    {"lu", "cholesky", "ilu", "icc", "bjacobi", "asm", "gasm", "redundant", "telescope", "ksp"}
)
"""Preconditioners that can be created again from options alone; multigrid would lose its levels."""

WORKSPACE_ERRORS = (-8, -9, -17, -20)
"""Values of INFOG(1) for which a larger ICNTL(14) helps."""

LARGEST_MARGIN = 2000
"""Largest ICNTL(14) of MUMPS that is tried [%]."""


def replace_failed(ksp: PETSc.KSP) -> bool:
    """Replace the PC of a KSP if its set-up failed; the KSP's operators must then be set again; collective.

    Returns whether another solve with the same matrix may succeed, as MUMPS has more workspace now.
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
    margin = larger_margin(factors)
    if margin is None:
        return False
    PETSc.Options().setValue(f"{factors.getOptionsPrefix() or ''}mat_mumps_icntl_14", margin)
    return True


def larger_margin(factors: PETSc.Mat) -> int | None:
    """A larger ICNTL(14) [%] for factors of MUMPS that failed; None if it would not help."""
    margin = factors.getMumpsIcntl(14)
    helps = factors.getMumpsInfog(1) in WORKSPACE_ERRORS and margin < LARGEST_MARGIN
    return max(20, 4 * margin) if helps else None
