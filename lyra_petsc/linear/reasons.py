"""Messages for PETSc's converged reasons and errors."""

from __future__ import annotations

from petsc4py import PETSc

NOT_A_NUMBER = -4
"""SNES reason for a residual that is not a number; its name changed in PETSc 3.25."""

UNINFORMATIVE = ("error code", "See https://")
"""Prefixes of lines in PETSc's errors that do not name the cause."""

_NOT_A_NUMBER = "the residual is not a finite number"
_SNES = {
    PETSc.SNES.ConvergedReason.DIVERGED_MAX_IT: "Newton did not converge within its iterations",
    PETSc.SNES.ConvergedReason.DIVERGED_LINE_SEARCH: "the line search found no smaller energy",
    PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE: "the linear solve failed",
    NOT_A_NUMBER: _NOT_A_NUMBER,
    PETSc.SNES.ConvergedReason.DIVERGED_FUNCTION_DOMAIN: _NOT_A_NUMBER,
    PETSc.SNES.ConvergedReason.DIVERGED_FUNCTION_COUNT: "the limit of residual evaluations was reached",
    PETSc.SNES.ConvergedReason.DIVERGED_LOCAL_MIN: "the line search is stuck in a point that is no solution",
    PETSc.SNES.ConvergedReason.DIVERGED_INNER: "the inner solve failed",
}
_KSP = {
    PETSc.KSP.ConvergedReason.DIVERGED_MAX_IT: "too many linear iterations",
    PETSc.KSP.ConvergedReason.DIVERGED_DTOL: "the linear residual grew",
    PETSc.KSP.ConvergedReason.DIVERGED_BREAKDOWN: "the Krylov method broke down",
    PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_PC: "the preconditioner is not positive definite",
    PETSc.KSP.ConvergedReason.DIVERGED_NANORINF: "the linear system holds a number that is not finite",
    PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_MAT: "the matrix is not positive definite",
    -11: "the preconditioner could not be set up (a zero pivot?)",
}
_PRECONDITIONER = {
    PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_PC,
    PETSc.KSP.ConvergedReason.DIVERGED_NANORINF,
    PETSc.KSP.ConvergedReason.DIVERGED_BREAKDOWN,
    PETSc.KSP.ConvergedReason.DIVERGED_MAX_IT,
    PETSc.KSP.ConvergedReason.DIVERGED_DTOL,
    -11,
}


def failure_reason(snes: PETSc.SNES, ksp: PETSc.KSP) -> str:
    """Message that says why a nonlinear solve failed."""
    reason = snes.getConvergedReason()
    message = _SNES.get(reason, f"SNES stopped with reason {reason}")
    linear = ksp.getConvergedReason()
    if linear < 0:
        message += f": {_KSP.get(linear, f'KSP stopped with reason {linear}')}"
    return message


def preconditioner_failed(ksp: PETSc.KSP) -> bool:
    """Whether another preconditioner might help."""
    return ksp.getConvergedReason() in _PRECONDITIONER


def in_set_up(error: Exception) -> bool:
    """Whether PETSc raised an error while it set up a preconditioner."""
    return "PCSetUp() at " in str(error)


def error_message(error: Exception) -> str:
    """The innermost message of an error from within PETSc, in one line."""
    lines = [line.split("] ", 1)[-1].strip() for line in str(error).splitlines()]
    causes = [line for line in lines if line and "() at " not in line and not line.startswith(UNINFORMATIVE)]
    return "; ".join(causes[-2:]) if causes else " ".join(str(error).split())
