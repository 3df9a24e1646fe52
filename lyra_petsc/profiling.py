"""Our names in PETSc's own profile (``-log_view``): stages of a run, events of a Newton iteration.

Nothing is measured here and nothing costs more than a microsecond unless the user asks PETSc to log.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import ParamSpec, TypeVar

from petsc4py import PETSc

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

# registered here, as PETSc adds up the stages of all ranks by number: the order must not depend on the way
# a rank takes
STAGES = {
    name: PETSc.Log.Stage(name) for name in ("mesh", "partition", "assembly", "solve", "balance", "output")
}

RESIDUAL, JACOBIAN = "AssembleResidual", "AssembleJacobian"
"""Events, the latter once a Newton iteration; PETSc's table has room for names of 16 letters."""

JACOBIAN_AGAIN = "AssembleAgain"
"""The Jacobian with more regularisation, where the linear solve met negative curvature."""

FROZEN = "AssembleFrozen"
"""Once an attempt at a step: damping, loads and geometry that stay as they are during it."""


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Let PETSc charge what happens in the block to the stage ``name``; ended also by an exception."""
    if name not in STAGES:
        STAGES[name] = PETSc.Log.Stage(name)
    STAGES[name].push()
    try:
        yield
    finally:
        STAGES[name].pop()


def logged(name: str) -> Callable[[Callable[Arguments, Result]], Callable[Arguments, Result]]:
    """Decorate a function to be the event ``name``: each call counts once, also if it raises."""
    event = PETSc.Log.Event(name)

    def decorate(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
        @wraps(function)
        def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
            with event:
                return function(*args, **kwargs)

        return call

    return decorate
