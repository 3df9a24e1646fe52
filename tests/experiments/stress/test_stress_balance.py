"""Balances of real steps, which show broken kernels and unsolved steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from lyra_petsc.experiments.stress.cases import selected
from lyra_petsc.experiments.stress.step_balance import force_work
from lyra_petsc.experiments.stress.stress_runner import StressOutcome, run_case
from lyra_petsc.experiments.stress.stress_scenes import (
    Scope,
    Setting,
    StressCase,
    base_scene,
    hanging_sheet,
    set_material,
    set_wind,
)
from lyra_petsc.experiments.stress.verdicts import RunRecord
from lyra_petsc.terms.bending.hinge import Bending
from lyra_petsc.terms.membrane import Membrane

Array = np.ndarray
CELLS = 8


def stepped_by(comm: MPI.Comm, integrator: str, **changes: Any) -> StressOutcome:
    """A small hanging sheet in a breeze, with ``changes``."""
    content = set_wind(hanging_sheet(CELLS), 3.0) | changes
    content["time"]["integrator"] = integrator
    case = StressCase("try", "a try", base_scene, steps=4)
    return run_case(comm, case, Setting(content, False, Scope.QUICK))


run = partial(stepped_by, integrator="beuler")


def handled(seconds: float) -> dict[str, Any]:
    """A handle that swings, a spring, and a load."""
    motion = [{"time": 0.0}, {"time": seconds, "translate": [0.02, -0.03, 0.05]}]
    return {
        "handles": [
            {"nodes": [0], "motion": "shake"},
            {"nodes": [CELLS], "stiffness": 50.0, "motion": "shake"},
        ],
        "motions": {"shake": motion},
        "loads": [{"nodes": [40], "force": [0.1, 0.0, 0.0]}, {"pressure": 2.0}],
    }


@pytest.mark.parallel(2)
@pytest.mark.parametrize(
    "changes",
    [
        {},
        handled(0.02),
        {"handles": [{"group": "bottom", "clamp": True, "motion": "turn"}], "motions": {
            "turn": [{"time": 0.0}, {"time": 0.02, "rotate": {"axis": [1, 0, 0], "degrees": 20}}]}},
        {"handles": [], "initial": {"angular_velocity": [5, 20, 3], "noise": 0.01}},
    ],
    ids=["hung", "handles, spring and loads", "clamp that turns", "tumbling"],
)  # fmt: skip
def test_every_balance_holds(comm: MPI.Comm, changes: dict[str, Any]) -> None:
    outcome = run(comm, **changes)
    assert len(outcome.record.balances) == 4
    assert outcome.failures == {}
    assert all(balance.turned_over > 1e3 * balance.tolerance for balance in outcome.record.balances)
    assert not any(balance.jumped for balance in outcome.record.balances)


def test_a_fast_jump_of_hinges_is_noticed(comm: MPI.Comm) -> None:
    [case] = selected(["pressed"], Scope.QUICK)
    outcome = run_case(comm, case, Setting(hanging_sheet(10), False, Scope.QUICK))
    assert any(balance.jumped for balance in outcome.record.balances)
    assert "jumped" in outcome.verdicts["energy"].message
    assert outcome.failures == {}


def test_a_balance_does_not_miss_a_narrow_barrier(comm: MPI.Comm) -> None:
    """In steps of thousands of gaps."""
    [case] = selected(["contact-gap-1e-5-10ms"], Scope.USUAL)
    outcome = run_case(comm, replace(case, steps=9), Setting(hanging_sheet(10), False, Scope.QUICK))
    assert any(balance.jumped for balance in outcome.record.balances)
    assert outcome.failures == {}


class Stops:
    """Springs that act beyond points (m,) on the x axis: their second derivatives jump, as where the nearest
    feature of a pair in contact changes."""

    registration = SimpleNamespace(of_contact=True)

    def __init__(self, at: Array) -> None:
        self.at = at

    def energies(self, x: Array, frozen: None) -> Array:
        return 0.5 * np.maximum(x[:, :1] - self.at, 0.0).ravel() ** 2

    def add_gradient(self, x: Array, frozen: None, out: Array) -> None:
        out[:, 0] += np.maximum(x[:, :1] - self.at, 0.0).sum(axis=1)


def test_the_work_of_forces_with_kinks_is_integrated_to_its_tolerance() -> None:
    """Two numbers of equal panels may agree by chance."""
    x0, dx, tolerance = np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]]), 1e-8
    for seed in range(60):
        stops = Stops(np.random.default_rng(seed).random(5))
        terms: dict[Any, Any] = {stops: None}
        work, _ = force_work(MPI.COMM_SELF, 1, terms, {}, x0, dx, tolerance, skin=0.01)
        assert abs(work - stops.energies(x0 + dx, None).sum()) < tolerance


@pytest.mark.parallel(2)
def test_every_balance_holds_where_triangles_collapse(
    comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = [1.0]
    real = Bending.energies

    def energies(self: Bending, x: Array, *more: Any) -> Array:
        left.append(float(self.weights(x).min(initial=1.0)))
        return real(self, x, *more)

    monkeypatch.setattr(Bending, "energies", energies)
    [case] = selected(["wind-200"], Scope.QUICK)
    outcome = run_case(comm, case, Setting(hanging_sheet(CELLS), False, Scope.QUICK))
    assert comm.allreduce(min(left), op=MPI.MIN) < 0.1
    assert outcome.failures == {}


def broken(term: type, factor: float) -> Callable[[Any, Array, Any, Array], None]:
    """A gradient that is not exactly that of the energy."""
    real = term.add_gradient

    def add_gradient(self: Any, x: Array, frozen: Any, out: Array) -> None:
        mine = np.zeros_like(out)
        real(self, x, frozen, mine)
        out += factor * mine

    return add_gradient


@pytest.mark.parametrize("integrator", ["beuler", "bdf2"])
@pytest.mark.parametrize(("term", "factor"), [(Membrane, 1.001), (Bending, 1.01)])
def test_forces_that_are_not_a_gradient_violate_the_identity(
    comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch, term: type, factor: float, integrator: str
) -> None:
    monkeypatch.setattr(term, "add_gradient", broken(term, factor))
    stiff = {"solver": {"force_tolerance": 1e-9, "step_tolerance": 1e-6}}
    assert "energy" in stepped_by(comm, integrator, initial={"noise": 0.01}, **stiff).failures


@pytest.mark.parametrize(("integrator", "torque"), [("beuler", False), ("beuler", True), ("midpoint", False)])
def test_internal_forces_that_do_not_balance_are_noticed(
    comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch, integrator: str, torque: bool
) -> None:
    real = Membrane.add_gradient

    def add_gradient(self: Membrane, x: Array, frozen: Any, out: Array) -> None:
        real(self, x, frozen, out)
        out[20, 0] += 1e-3
        out[60, 0] -= 1e-3 * torque

    monkeypatch.setattr(Membrane, "add_gradient", add_gradient)
    message = stepped_by(comm, integrator).failures["momentum"].message
    assert not torque or "angular" in message


def test_unsolved_steps_are_noticed(comm: MPI.Comm) -> None:
    assert "equations" in run(comm, petsc={"snes_rtol": 0.1}).failures


def test_negative_damping_is_noticed(comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch) -> None:
    real = Membrane.__init__

    def init(self: Membrane, elements: Any, *more: Any) -> None:
        elements.data["damping"][:] *= -1.0
        real(self, elements, *more)

    monkeypatch.setattr(Membrane, "__init__", init)
    content = set_material(hanging_sheet(CELLS), damping=1e-3)
    case = StressCase("try", "a try", base_scene, steps=4)
    outcome = run_case(comm, case, Setting(content, False, Scope.QUICK))
    assert "no gain" in outcome.failures


@pytest.mark.parallel(2)
@pytest.mark.parametrize("integrator", ["midpoint", "alpha2", "bdf2"])
def test_stages_of_other_integrators_are_balanced(comm: MPI.Comm, integrator: str) -> None:
    outcome = stepped_by(comm, integrator, **handled(0.02))
    assert outcome.failures == {}
    assert {"equations", "resolved", "energy", "momentum"} < set(outcome.verdicts)
    assert "no gain" not in outcome.verdicts
    assert all(balance.turned_over > 1e3 * balance.tolerance for balance in outcome.record.balances)


@pytest.mark.parallel(2)
@pytest.mark.parametrize("integrator", ["midpoint", "alpha2", "bdf2"])
def test_stages_with_directors_are_balanced(comm: MPI.Comm, integrator: str) -> None:
    """Clamped, damped and rotating fast, with the frames of the step."""
    turn = [{"time": 0.0}, {"time": 0.04, "rotate": {"axis": [1, 0, 0], "degrees": 120}}]
    handles = [{"group": "bottom", "clamp": True, "motion": "turn"}]
    content = set_material(set_wind(hanging_sheet(CELLS), 3.0), bending_model="midedge") | {
        "handles": handles,
        "motions": {"turn": turn},
    }
    content["time"]["integrator"] = integrator
    case = StressCase("a", "b", base_scene, steps=4)
    assert run_case(comm, case, Setting(content, True, Scope.QUICK)).failures == {}


def test_semi_implicit_steps_have_no_balance(comm: MPI.Comm) -> None:
    outcome = stepped_by(comm, "semi-implicit")
    assert outcome.passed
    assert outcome.record.balances == []
    assert set(outcome.verdicts) == {"converged", "softening", "whole run"}


def test_an_empty_record_fails() -> None:
    assert not StressOutcome(StressCase("a", "b", base_scene), record=RunRecord(1, 1.0, 1.0)).passed
