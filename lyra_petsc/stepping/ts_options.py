"""Options of PETSc's TS that contradict a scene."""

from __future__ import annotations

from petsc4py import PETSc

from lyra_petsc.errors import InputError
from lyra_petsc.scene.control import INTEGRATORS
from lyra_petsc.solvers.options import is_set


def refuse_contradictions(ts: PETSc.TS, expected: str) -> None:
    """Raise InputError for what would make TS, its options read, solve other than ``expected`` does."""
    kind = ts.getType()
    if kind != expected:
        raise InputError(
            f"'{kind}' is not what solves the steps of this scene; choose time.integrator in the scene "
            f"({', '.join(INTEGRATORS)}) and leave -ts_type out",
            key="-ts_type",
        )
    for name in ("ts_theta_endpoint", "ts_theta_theta"):
        if is_set(name):
            raise InputError("has no meaning for the reduced velocity form; leave it out", key=f"-{name}")
    if PETSc.Options().getString("ts_adapt_type", "none") != "none":
        raise InputError("TS cannot judge steps of the reduced form; leave it out", key="-ts_adapt_type")
