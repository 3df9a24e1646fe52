"""The integrator and the step control that PETSc's TS options choose.

``-ts_type`` and ``-ts_adapt_type`` override a scene's ``time``. The TS itself only solves for the stage of
the integrator, so it must not read them (`hidden_options`).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from petsc4py import PETSc
from pydantic import ValidationError

from lyra_petsc.errors import InputError
from lyra_petsc.linear.petsc_options import is_set, petsc_number
from lyra_petsc.scene.schema import Scene, Time

ALLOWED = (
    "beuler, theta (-ts_theta_theta 0.5: midpoint, 1: beuler), bdf (-ts_bdf_order 2: bdf2) and alpha2; "
    "without -ts_type it is the scene's time.integrator"
)
"""The values of ``-ts_type`` that are accepted, for a message."""

TOLERANCE = 1e-3
"""Tolerance for ``-ts_adapt_type basic`` if the scene has no ``time.tolerance``."""

STEP_OPTIONS = ("ts_dt", "ts_time_step")
"""Names of the option for Δt: in PETSc up to 3.24, and from 3.25 on."""

OWN_OPTIONS = ("ts_type", "ts_theta_theta", "ts_bdf_order", "ts_adapt_type", *STEP_OPTIONS)
"""Options that the TS which solves the stages must not read."""


def step_option() -> str:
    """The one of `STEP_OPTIONS` that is set, or the first if none is.

    Raises
    ------
    InputError
        If both are set.
    """
    names = [name for name in STEP_OPTIONS if is_set(name)]
    if len(names) > 1:
        raise InputError("mean the same; leave one out", key=" and ".join(f"-{name}" for name in names))
    return names[0] if names else STEP_OPTIONS[0]


def with_ts_options(scene: Scene) -> Scene:
    """The scene with the integrator and the step control of the PETSc options.

    Raises
    ------
    InputError
        If there is no such integrator or step control.
    """
    if is_set("ts_theta_endpoint"):
        raise InputError("has no meaning for the stage equations; leave it out", key="-ts_theta_endpoint")
    changes = _integrator(scene.time) | _steps(scene.time)
    if not changes:
        return scene
    content = scene.time.model_dump(exclude_none=True) | changes
    if content["integrator"] != "alpha2":
        content.pop("spectral_radius", None)
    if content["step"] != "auto":
        content.pop("tolerance", None)
    try:
        return scene.model_copy(update={"time": Time.model_validate(content)})
    except ValidationError as error:
        raise InputError(error.errors()[0]["msg"], key="-ts_type or -ts_adapt_type") from None


def _integrator(time: Time) -> dict[str, Any]:
    """Entries of ``time`` that ``-ts_type`` changes."""
    kind = PETSc.Options().getString("ts_type", "")
    if not is_set("ts_type"):
        for name, type_ in (("ts_theta_theta", "theta"), ("ts_bdf_order", "bdf")):
            if is_set(name):
                raise InputError(f"goes with -ts_type {type_}; leave it out", key=f"-{name}")
        return {}
    if time.analysis == "static":
        raise InputError("has no meaning in a static analysis; leave it out", key="-ts_type")
    if kind == PETSc.TS.Type.THETA:
        theta = petsc_number("ts_theta_theta", 0.5)
        if theta not in (0.5, 1.0):
            raise InputError(f"is 0.5 (midpoint) or 1 (beuler) here, not {theta:g}", key="-ts_theta_theta")
        return {"integrator": "midpoint" if theta == 0.5 else "beuler"}
    if kind == PETSc.TS.Type.BDF:
        order = petsc_number("ts_bdf_order", 2)
        if order != 2:
            raise InputError(f"is 2 here, not {order:g}", key="-ts_bdf_order")
        return {"integrator": "bdf2"}
    if kind not in (PETSc.TS.Type.BEULER, PETSc.TS.Type.ALPHA2):
        raise InputError(f"'{kind}' is none of the integrators here: {ALLOWED}", key="-ts_type")
    return {"integrator": kind}


def _steps(time: Time) -> dict[str, Any]:
    """Entries of ``time`` that ``-ts_adapt_type`` changes."""
    if not is_set("ts_adapt_type"):
        return {}
    kind = PETSc.Options().getString("ts_adapt_type", "")
    if kind not in ("none", "basic"):
        raise InputError(
            f"is none (fixed steps) or basic (steps by time.tolerance) here, not '{kind}'",
            key="-ts_adapt_type",
        )
    if time.analysis == "static":
        if kind == "basic":
            raise InputError("has no meaning in a static analysis; leave it out", key="-ts_adapt_type")
        return {}
    if kind == "basic":
        return {} if time.adaptive else {"step": "auto", "tolerance": time.tolerance or TOLERANCE}
    if not time.adaptive:
        return {}
    if not is_set(step_option()):
        raise InputError("none needs the length of the steps: give -ts_dt", key="-ts_adapt_type")
    return {"step": petsc_number(step_option(), 0.0)}


@contextmanager
def hidden_options() -> Iterator[None]:
    """A context in which `OWN_OPTIONS` are not in the database, so that a TS does not read them."""
    database = PETSc.Options()
    kept = {name: database.getString(name, "") for name in OWN_OPTIONS if is_set(name)}
    for name in kept:
        database.delValue(name)
    try:
        yield
    finally:
        for name, value in kept.items():
            database.setValue(name, value)
            database.getString(name, "")  # marks the option as used
