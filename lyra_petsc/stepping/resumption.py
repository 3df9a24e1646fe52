"""What a checkpoint holds of a run besides positions and velocities, and how a run continues from it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from lyra_petsc.arrays import Array
from lyra_petsc.stepping import term_states
from lyra_petsc.stepping.problem import refuse_contact, refuse_overrun

if TYPE_CHECKING:
    from lyra_petsc.stepping.simulation import SteppedScene


def saved_state(run: SteppedScene) -> tuple[dict[str, Array], dict[str, Any]]:
    """Arrays (n_owned, 3) and numbers of a checkpoint besides positions and velocities; collective.

    With them `resume` continues as if the run had never stopped.
    """
    equations, time = run.problem.equations, run.time
    arrays, integrator = equations.integrators.saved_state()
    balance, budget = run.energy_balance.saved_state()
    of_stepper, stepper = run.stepper.saved_state(time)
    arrays = arrays | balance | of_stepper
    scalars = {
        "time": time,
        "step": run.step_number,
        "scheme": run.scene.time.scheme,
        "budget": budget,
        "totals": dict(run.totals),
        "stability": run.stability,
        **run.run_notes.saved_state(),
        **run.control.saved_state(),
        "estimated_error": 0.0 if run.accuracy is None else run.accuracy.estimated,
        "integrator": integrator,
        **stepper,
        "energy": None if run.guard is None else run.guard.saved_state(),
        "jumps": run.jumps,
        "late_starts": sorted(equations.reference.late),
        "obstacles": {} if equations.contact is None else equations.contact.places,
    }
    if run.equilibrium is not None:
        more, scalars["equilibrium"] = run.equilibrium.saved_state(time)
        arrays |= more
    if run.accuracy is not None:
        more, numbers = run.accuracy.local_error.saved_state()
        arrays, scalars["integrator"] = arrays | more, integrator | numbers
    return arrays, scalars


def resume(
    run: SteppedScene,
    arrays: Mapping[str, Array],
    scalars: Mapping[str, Any],
    edges: Mapping[str, Array],
    elements: Mapping[str, term_states.ElementState],
) -> None:
    """Continue from a `saved_state`; x and v of the owned rows are in ``run.problem.equations`` already.

    ``edges`` and ``elements`` are those of `term_states`; collective.
    """
    equations = run.problem.equations
    equations.state.update_ghosts()
    term_states.restore_fixed(
        equations.active.stateful, equations.points, equations.x, arrays, edges, elements
    )
    # loads and handles that only the changed scene starts earlier start now; the others have started
    equations.reference.record_starts(run.time, equations.x)
    equations.hold_targets(run.time)
    refuse_overrun(equations, run.scene, f"at {run.time_text()}")
    refuse_contact(equations, run.scene, f"at {run.time_text()}")
    for jump in scalars["jumps"]:
        run.expect_jump(jump)
    run.energy_balance.restore(arrays, scalars["budget"])
    run.control.restore(scalars)
    if run.equilibrium is not None:
        run.equilibrium.restore(arrays, scalars["equilibrium"], run.time)
    equations.integrators.restore(arrays, scalars["integrator"])
    if run.guard is not None:
        run.guard.restore(scalars["energy"], same=scalars["scheme"] == run.scene.time.scheme)
    if run.accuracy is not None:
        run.accuracy.restore(arrays, scalars)
    for friction in equations.active.sliding:
        if friction.name in elements:
            pairs = elements[friction.name]
            term_states.restore_changing(friction, equations.points, pairs, scalars["obstacles"])
            friction.initialise_pairs(equations.x, equations.step.frozen[friction])
    run.stepper.restore(arrays, scalars, run.time, run.step_number)
    run.run_notes.restore(scalars)
