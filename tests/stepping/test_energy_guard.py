"""Energy guard: steps that create energy are repeated, and numerical dissipation is reported."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from numpy.typing import NDArray
from physics import CLOTH, finished, grid, scene_of, shape

from lyra_petsc.errors import SolverError
from lyra_petsc.stepping.simulation import SteppedScene

MEMBRANE = {"c11": 1000.0, "c22": 1000.0, "c12": 300.0, "c33": 350.0}
SHELL = {"membrane": MEMBRANE, "bending": 1e-3}

FREE: dict[str, Any] = {
    "mesh": grid(1.0, 1.0, 12, 12, "alternating"),
    "material": {"density": 0.15, **SHELL},
    "initial": {"noise": 0.005, "angular_velocity": [0.0, 0.0, 2.0]},
    "solver": {},
}
"""A free sheet without loads, too stiff for a Δt of 10 ms."""


def simulation(
    comm: MPI.Comm, integrator: str, content: dict[str, Any], end: float = 0.2, step: float = 0.01
) -> SteppedScene:
    time = {"end": end, "step": step, "integrator": integrator}
    return SteppedScene(comm, scene_of({"time": time} | content))


def run(one: SteppedScene) -> list[float]:
    """Energies [J] at the start and after each step."""
    energies = [one.budget.total]
    while not one.finished:
        one.step()
        energies.append(one.budget.total)
    return energies


def surrounded(drift: list[float], *, contact: bool) -> dict[str, Any]:
    """A sheet in wind, with handles that hold and let go, and a floor that it falls on; all drift."""
    along = {"motion": "drift", "interpolation": "linear"}
    held = [{"nodes": [0, 1], "until": 0.06}, {"nodes": [29], "stiffness": 50.0}]
    floor = {"plane": {"point": [0, 0, -0.03], "normal": [0, 0, 1]}} | along
    return {
        "mesh": grid(0.6, 0.4, 5, 4, "alternating"),
        "material": {"density": 0.15, "damping": 0.002, **SHELL},
        "gravity": [0.0, 0.0, -9.81],
        "wind": {"velocity": [1.0 + drift[0], drift[1], drift[2] - 2.0], "density": 1.2},
        "initial": {"noise": 0.005, "angular_velocity": [0.0, 3.0, 0.0], "velocity": drift},
        "motions": {"drift": [{"time": 0.0}, {"time": 1.0, "translate": drift}]},
        "handles": [handle | along for handle in held],
    } | ({"contact": {"gap": 0.005}, "obstacles": {"floor": floor}} if contact else {})


@pytest.mark.parametrize(
    ("integrator", "contact", "end", "step"),
    [
        ("midpoint", False, 0.1, 0.02),
        ("bdf2", False, 0.1, 0.02),
        ("alpha2", True, 0.1, 0.02),
        ("alpha2", False, 0.002, 0.0005),  # far below the time between keyframes of the handles
    ],
)
def test_who_moves_along_sees_the_same_steps(
    integrator: str,
    contact: bool,
    end: float,
    step: float,
) -> None:
    def taken(drift: list[float]) -> tuple[list[float], dict[str, Any], NDArray[np.float64]]:
        one = simulation(MPI.COMM_SELF, integrator, surrounded(drift, contact=contact), end, step)
        times = []
        while not one.finished:
            times.append(one.step().time)
        assert one.guard is not None
        content, x = one.guard.content(), shape(one) - one.time * np.array(drift)
        one.destroy()
        return times, content, x

    (times, content, x), (others, other, y) = taken([0.0, 0.0, 0.0]), taken([-2.0, 1.0, 3.0])
    np.testing.assert_allclose(others, times, rtol=0, atol=1e-9)
    np.testing.assert_allclose(y, x, rtol=0, atol=1e-6 * step / 0.02)
    assert other["repeated"] == content["repeated"]
    assert content["repeated"] > 0 or integrator in ("beuler", "midpoint") or step < 0.02
    for name in ("scale", "numerical_dissipation", "numerical_gain"):
        assert other[name] == pytest.approx(content[name], rel=1e-5, abs=1e-9), name


@pytest.mark.parallel(2)
@pytest.mark.parametrize("integrator", ["midpoint", "alpha2", "bdf2", "beuler"])
def test_a_free_sheet_gains_nothing(integrator: str, comm: MPI.Comm) -> None:
    one = simulation(comm, integrator, FREE)
    energies, content = run(one), one.guard.content() if one.guard else {}
    notes = [note for note in one.notes if "out of nothing" in note]
    one.destroy()
    assert max(energies) < 1.05 * energies[0]
    assert content["scale"] >= max(energies)
    assert len(notes) == (integrator != "beuler")
    assert (content["repeated"] > 0) == bool(notes)
    if integrator == "beuler":
        lost = (energies[0] - energies[-1]) / content["scale"]
        assert content["numerical_dissipation"] == pytest.approx(lost, rel=1e-6)
        identity = content["identity"]
        assert identity["velocity_changes"] - identity["bracket"] == pytest.approx(lost, rel=1e-4)
    else:
        assert "time.integrator: b" in notes[0]


def _wringing(side: float) -> list[dict[str, Any]]:
    """A motion by four turns in 3 s that also approaches the other end."""
    turn = {"axis": [1.0, 0.0, 0.0], "degrees": side * 1440.0}
    return [{"time": 0.0}, {"time": 3.0, "rotate": turn, "translate": [-0.14 * side, 0.0, 0.0]}]


def test_handles_that_start_slowly_count_in_the_scale() -> None:
    """The small gain of a damped sheet in its first step is also relative to the handles' energy."""
    content = {
        "mesh": grid(0.6, 0.3, 18, 9, "alternating") | {"transform": {"translate": [-0.3, -0.15, 0.0]}},
        "material": {"cloth": "gray-interlock", "damping": 0.02},
        "handles": [{"group": side, "motion": side} for side in ("left", "right")],
        "motions": {"left": _wringing(-1.0), "right": _wringing(1.0)},
    }
    one = simulation(MPI.COMM_SELF, "bdf2", content, end=0.02)
    run(one)
    one.destroy()


@pytest.mark.parametrize("integrator", ["bdf2", "alpha2"])
def test_heat_of_rotating_parts_is_second_order(integrator: str) -> None:
    """A damped swinging cloth: with the heat of chords about the end of a step, bdf2 gained 1 %."""
    content = {
        "mesh": grid(0.5, 0.5, 6, 6, "alternating"),
        "material": {"cloth": "gray-interlock", "damping": 0.02},
        "gravity": [0.0, 0.0, -9.81],
        "handles": [{"nodes": [0, 6]}],
    }
    wrong = []
    for step in (0.005, 0.0025):
        one = simulation(MPI.COMM_SELF, integrator, content, 0.3, step)
        run(one)
        assert one.guard is not None
        wrong.append(one.guard.gains.total / one.guard.gains.heat)
        one.destroy()
    assert max(wrong) < 1e-3
    assert abs(wrong[1]) < abs(wrong[0]) / 3.0


@pytest.mark.parametrize("integrator", ["midpoint", "alpha2"])
def test_round_off_of_a_sheet_at_rest_is_no_gain(integrator: str) -> None:
    content = {
        "mesh": grid(0.2, 0.2, 4, 4) | {"transform": {"translate": [1.0, 0.0, 0.0]}},
        "material": CLOTH | {"bending": 1e-4, "damping": 0.02},
        "gravity": [0, 0, 0],
        "handles": [{"group": "left", "motion": "turn"}],
        "motions": {"turn": [{"time": time, "rotate": {"axis": [0, 0, 1], "degrees": 0}} for time in (0, 1)]},
        "time": {"end": 0.1, "step": 0.0025, "integrator": integrator},
    }
    with finished(MPI.COMM_SELF, content) as simulation:
        assert simulation.totals["rejected"] == 0


@pytest.mark.parallel(2)
def test_stiff_damping_creates_no_energy_after_backward_euler_steps(comm: MPI.Comm) -> None:
    """Moments curl a plate on a floor and release it: velocities jump when it touches the floor."""
    content = {
        "mesh": grid(0.4, 0.4, 4, 4, "alternating") | {"transform": {"translate": [-0.2, -0.2, 0.03]}},
        "material": {"young": 1e7, "poisson": 0.3, "thickness": 0.001, "density": 0.3, "damping": 0.005},
        "gravity": [0.0, 0.0, -9.81],
        "contact": {"friction": 0.4},
        "obstacles": {"floor": {"plane": {"point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}}},
        "loads": [{"group": "left", "moment": 0.05}, {"group": "right", "moment": -0.05, "from": 0.1}],
        "solver": {},
    }
    one = simulation(comm, "bdf2", content, 0.25, 0.005)
    run(one)
    notes, rejected = list(one.notes), one.totals["rejected"]
    one.destroy()
    assert any("repeated by backward Euler" in note for note in notes)
    assert rejected < 20


@pytest.mark.parallel(2)
@pytest.mark.parametrize("integrator", ["bdf2", "alpha2"])
def test_stiffly_damped_sheets_start_with_a_step_of_backward_euler(integrator: str, comm: MPI.Comm) -> None:
    """Held at an edge, and pulled by gravity in its plane: generalised-α moved it against gravity."""
    content = {
        "mesh": grid(1.0, 1.0, 3, 3),
        "material": {"young": 6e6, "poisson": 0.3, "thickness": 0.005, "density": 0.2, "damping": 0.016},
        "gravity": [5.0, -3.0, -6.0],
        "handles": [{"group": "left"}],
    }
    ends, rejected = [], []
    for step in (0.01, 0.005, 0.0025, 0.0003125):
        one = simulation(comm, integrator, content, 0.08, step)
        run(one)
        ends.append(shape(one))
        rejected.append(one.totals["rejected"])
        one.destroy()
    errors = [np.abs(end - ends[-1]).max() for end in ends[:-1]]
    assert 0 < rejected[0] <= 3
    assert errors[0] < 0.01
    assert errors[2] < errors[1] / 3.3 < errors[0] / 9.0  # of second order


def test_checkpoints_have_the_state_of_the_guard() -> None:
    one, other = (simulation(MPI.COMM_SELF, "alpha2", FREE) for _ in range(2))
    for _ in range(7):
        one.step()
    arrays, scalars = one.saved_state()
    equations = one.problem.equations
    other.problem.equations.state.set(equations.x.copy(), equations.v.copy())
    copies = {name: values.copy() for name, values in arrays.items()}
    other.resume(copies, json.loads(json.dumps(scalars)))
    assert run(other) == pytest.approx(run(one), rel=2e-6)  # with other first guesses
    assert one.guard is not None
    assert other.guard is not None
    assert one.guard.gains.repeated == other.guard.gains.repeated > 0
    assert other.guard.gains.recent == pytest.approx(one.guard.gains.recent, abs=2e-7)
    assert other.guard.gains.scale == pytest.approx(one.guard.gains.scale, rel=1e-12)
    for each in (one, other):
        each.destroy()


@pytest.mark.parallel(2)
def test_insufficient_linear_solves_are_repeated_alike_on_all_ranks(comm: MPI.Comm) -> None:
    """A stiff hanging sheet with long steps, which are far from linear: round-off must not grow."""
    stiff = {key: 1e3 * c for key, c in MEMBRANE.items()}
    content = {
        "mesh": grid(1.0, 1.0, 12, 12, "alternating"),
        "material": {"density": 0.15, "membrane": stiff, "bending": 1e-5, "damping": 0.005},
        "gravity": [0.0, 0.0, -9.8],
        "handles": [{"nodes": [0, 12]}],
    }
    ends = []
    for on in (comm, MPI.COMM_SELF):
        one = simulation(on, "semi-implicit", content, 0.2, 0.04)
        rejected = one.step().rejected
        run(one)
        notes = [note for note in one.notes if "out of nothing" in note]
        ends.append(shape(one))
        one.destroy()
        assert rejected >= 1
        assert len(notes) == 1
        assert "time.integrator: beuler" in notes[0]
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-7)


STIFF = FREE | {
    "mesh": grid(1.0, 1.0, 6, 6, "alternating"),
    "material": {"density": 0.15, "membrane": {key: 1e4 * c for key, c in MEMBRANE.items()}, "bending": 1e-3},
}


@pytest.mark.parallel(2)
def test_the_run_ends_after_six_halvings(comm: MPI.Comm) -> None:
    one = simulation(comm, "midpoint", STIFF, 0.8, 0.04)
    states: list[tuple[NDArray[np.float64], dict[str, Any]]] = []

    def on() -> None:
        while True:
            states.append((one.problem.equations.x.copy(), dict(vars(one.budget))))
            one.step()

    words = r"even with Δt = 0.000625 s.*time.integrator: bdf2"
    with pytest.raises(SolverError, match=words) as error:
        on()
    before, start = states[-1]
    assert error.value.collective
    np.testing.assert_array_equal(one.problem.equations.x, before)
    assert dict(vars(one.budget)) == start
    one.destroy()


DRIVEN: dict[str, Any] = {
    "mesh": grid(0.5, 0.4, 5, 4, "alternating"),
    "material": {"density": 0.2, "damping": 0.01, **SHELL},
    "gravity": [0.0, 0.0, -9.81],
    "wind": {"velocity": [1.0, 2.0, 3.0], "density": 1.2, "drag": 0.3},
    "handles": [
        {"nodes": [0, 6, 12], "clamp": True, "motion": "sway"},
        {"nodes": [29], "stiffness": 30.0, "motion": "sway", "until": 0.1, "fade": 0.05},
        {"nodes": [5], "until": 0.08},
    ],
    "loads": [{"pressure": 1.0, "from": 0.05}, {"nodes": [20], "force": [0.0, 0.1, 0.0], "until": 0.12}],
    "motions": {
        "sway": [
            {"time": 0},
            {"time": 0.2, "rotate": {"axis": [0, 1, 0], "degrees": 60}, "translate": [0.1, 0, 0.1]},
        ]
    },
}
"""Handles and loads of all kinds, of which moving handles do most of the work."""


@pytest.mark.parallel(2)
def test_the_balance_includes_work_of_all_kinds(comm: MPI.Comm) -> None:
    """The gain of an integrator that conserves energy is the second-order error of the trapezoidal rule."""
    gains = []
    for step in (4e-3, 2e-3):
        one = simulation(comm, "midpoint", DRIVEN, 0.2, step)
        run(one)
        assert one.guard is not None
        gains.append(abs(one.guard.gains.total) / one.guard.gains.scale)
        assert one.guard.gains.repeated == 0
        one.destroy()
    assert gains[1] < 0.4 * gains[0] < 2e-3
