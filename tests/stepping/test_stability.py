"""Unstable equilibria are left for stable ones, and negative pivots are counted."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, finished, grid, scene_of, shape

from lyra_petsc.linear.matrix import AssembledMatrix
from lyra_petsc.stepping.simulation import SteppedScene
from lyra_petsc.stepping.statics import descent
from lyra_petsc.stepping.statics.stability import Examination, add_exact_hessian

pytestmark = pytest.mark.parallel(2)

BENDING, LENGTH = 1e-2, 1.0
CRITICAL = 7.837 * 0.8 * BENDING / (9.81 * LENGTH**3)
"""Density [kg/m²] at which an upright strip, clamped below, buckles under its weight (Greenhill 1881); hinges
on a diagonal grid bend with 0.8 B."""


STABLE = {"stable": True, "negative_pivots": 0, "neutral_pivots": 0, "rigid_motions": 0}


def notes(simulation: SteppedScene) -> list[str]:
    """Its notes, but for the one that no sheet has the numbers of these strips."""
    return [note for note in simulation.notes if not note.startswith("material: ")]


def strip(weight: float) -> dict[str, Any]:
    """An upright strip, clamped below, with a multiple of its critical weight."""
    upright = {"transform": {"rotate": {"axis": [1, 0, 0], "degrees": 90}}}
    stretch = {"c11": 1e3, "c22": 1e3, "c12": 0.0, "c33": 500.0}
    return {
        "mesh": grid(0.1, LENGTH, 2, 20) | upright,
        "material": {"density": weight * CRITICAL, "membrane": stretch, "bending": BENDING},
        "gravity": [0, 0, -9.81],
        "handles": [{"box": [[-1, -1, -1e-6], [2, 1, 1e-6]], "clamp": True}],
        "time": {"analysis": "static", "step": 1.0},
    }


def test_a_strip_below_its_critical_weight_stays_upright(comm: MPI.Comm) -> None:
    with finished(comm, strip(0.95)) as simulation:
        assert simulation.stability == STABLE
        assert not notes(simulation)
        assert np.abs(shape(simulation)[:, 1]).max() < 1e-6 * LENGTH


@pytest.mark.parametrize(
    "weight", [1.2, *(pytest.param(w, marks=pytest.mark.parallel(1)) for w in (1.05, 1.5))]
)
def test_a_strip_above_its_critical_weight_falls_over(weight: float, comm: MPI.Comm) -> None:
    with finished(comm, strip(weight)) as simulation:
        assert simulation.stability == STABLE
        assert "its lowest mode was followed once" in notes(simulation)[0]
        tip = shape(simulation)[-1]
        assert np.abs(tip[1]) > 0.3 * LENGTH
        equations = simulation.problem.equations
        free = equations.out_of_balance()
        assert comm.allreduce(np.abs(free).max(initial=0.0), MPI.MAX) < 1e-6 * weight * CRITICAL


def test_an_equilibrium_that_remains_unstable_is_noted(
    comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(descent, "MAX_DESCENTS", 0)
    with finished(comm, strip(1.5)) as simulation:
        assert simulation.stability == STABLE | {"stable": False, "negative_pivots": 1}
        assert "unstable" in notes(simulation)[0]
        assert "followed 0 times" in notes(simulation)[0]


PRESSED = {
    "mesh": grid(1.0, 1.0, 4, 4),
    "material": CLOTH,
    "handles": [{"group": "left"}, {"group": "right", "motion": "in"}],
    "motions": {"in": [{"time": 0}, {"time": 1, "translate": [-0.05, 0, 0]}]},
    "time": {"analysis": "static", "step": 1.0},
}


def test_wrinkles_without_bending_are_noted_and_not_followed(comm: MPI.Comm) -> None:
    with finished(comm, PRESSED) as simulation:
        assert simulation.stability["stable"] is False
        assert simulation.stability["negative_pivots"] == 15  # every free vertex gives way across the sheet
        assert "without bending" in simulation.notes[-1]
        assert np.abs(shape(simulation)[:, 2]).max() == 0.0


def test_motions_without_resistance_are_neutral(comm: MPI.Comm) -> None:
    still = PRESSED | {"motions": {"in": [{"time": 0}]}}
    with finished(comm, still) as simulation:
        assert simulation.stability["stable"] is None
        assert simulation.stability["neutral_pivots"] == 15
        assert "nothing resists 15 motions" in simulation.notes[-1]


def test_too_many_vertices_are_noted(comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lyra_petsc.stepping.statics.stability.MAX_VERTICES", 10)
    with finished(comm, strip(0.5)) as simulation:
        assert simulation.stability["stable"] is None
        assert simulation.stability["negative_pivots"] is None
        assert "more than the 10" in simulation.stability["stability_unknown"]
        assert any("is not known" in note for note in simulation.notes)


FOLLOWING: dict[str, dict[str, Any]] = {
    "pressure": {"loads": [{"pressure": 40.0}]},
    "wind": {"wind": {"velocity": [1.0, 2.0, 5.0], "density": 1.2, "drag": 0.2}},
    "neither": {},
}


@pytest.mark.parametrize("name", FOLLOWING)
def test_the_hessian_is_the_derivative_of_all_forces(name: str) -> None:
    """Its symmetric part if loads follow the shape; by finite differences on free unknowns."""
    scene = PRESSED | {"material": CLOTH | {"bending": 0.1}, "initial": {"noise": 0.02}} | FOLLOWING[name]
    simulation = SteppedScene(MPI.COMM_SELF, scene_of(scene))
    equations = simulation.problem.equations
    equations.take_loads(unbalanced=None)
    equations.x[:, 0] *= 0.95
    equations.state.forget()
    equations.begin_step(0.3, 0.7)
    free = np.flatnonzero(equations.step.prescribed.free)
    add_exact_hessian(equations, values := equations.discretisation.rows.zeros())
    matrix = AssembledMatrix(equations.points, equations.discretisation.rows.pattern, "aij")
    matrix.set(values)
    indices, columns, entries = matrix.mat.getValuesCSR()
    matrix.destroy()
    dense = np.zeros((equations.x.size, equations.x.size))
    dense[np.repeat(np.arange(len(dense)), np.diff(indices)), columns] = entries
    dense = dense[np.ix_(free, free)]
    slopes = np.empty_like(dense)
    here = equations.x.copy()
    for column, place in enumerate(free):
        force = []
        for sign in (1.0, -1.0):
            equations.x.ravel()[:] = here.ravel()
            equations.x.ravel()[place] += sign * 1e-6
            equations.state.forget()
            equations.begin_step(0.3, 0.7)
            force.append(equations.out_of_balance().ravel()[free])
        slopes[:, column] = (force[1] - force[0]) / 2e-6
    symmetric = 0.5 * (slopes + slopes.T)
    np.testing.assert_allclose(dense, symmetric, rtol=0, atol=1e-6 * np.abs(slopes).max())
    equations.x[:] = here
    equations.state.forget()
    equations.begin_step(0.3, 0.7)
    values = np.linalg.eigvalsh(symmetric)
    with Examination(equations, 1.4) as examination:
        assert examination.stability.negative == np.sum(values < 0.0)
        assert examination.stability.negative > 0
        mode = examination.lowest_mode()
        assert mode is not None
        assert mode.ravel()[free] @ symmetric @ mode.ravel()[free] < 0.0
    simulation.destroy()


@pytest.mark.parallel(1)
@pytest.mark.parametrize(("hardening", "stable"), [(0.01, None), (0.9, True)])
def test_a_strip_at_its_limit_is_not_called_stable_if_it_falls_as_it_yields(
    hardening: float, stable: bool | None
) -> None:
    # half its critical weight is more than the yielding root bears, less than the root that unloads
    tip = {"box": [[0.04, -1, LENGTH - 1e-6], [0.06, 1, LENGTH + 1e-6]]}
    content = strip(0.5)
    content["material"] |= {"yield_curvature": 0.3, "hardening": hardening}
    pushed = {"handles": [*content["handles"], tip | {"motion": "push", "axes": ["y"]}]}
    motions = {"push": [{"time": 0}, {"time": 1, "translate": [0, 0.2, 0]}]}
    time = {"analysis": "static", "step": 0.25}
    with finished(MPI.COMM_SELF, content | pushed | {"motions": motions, "time": time}) as simulation:
        assert simulation.stability == STABLE
        force = simulation.energy_balance.handle_forces(2)[1]
        x = simulation.problem.equations.x.copy()
        state = simulation.problem.terms["hinge_plasticity"].state()
    # now without the handle, under the same force
    released = SteppedScene(MPI.COMM_SELF, scene_of(content | {"loads": [tip | {"force": force.tolist()}]}))
    equations = released.problem.equations
    equations.state.set(x, np.zeros_like(x))
    released.problem.terms["hinge_plasticity"].restore({k: v.values for k, v in state.items()}, x)
    equations.begin_step(0.75, 1.0)
    equations.evaluate(equations.stationary_velocity())
    assert np.abs(equations.out_of_balance()).max() < 1e-6 * equations.forces.largest_force()
    with Examination(equations, LENGTH) as examination:
        stability = examination.stability
    released.destroy()
    assert (stability.stable, stability.negative) == (stable, 0)
    assert ("gives way where that yields further" in stability.reason) == (stable is None)
