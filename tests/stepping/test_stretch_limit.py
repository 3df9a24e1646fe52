"""``material.stretch_limit``: no accepted step stretches the sheet further, whatever solves it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import gathered, grid, scene_of, stepped

from lyra_petsc.errors import InputError, SolverError
from lyra_petsc.scene.schema import INTEGRATORS
from lyra_petsc.stepping.simulation import SteppedScene
from lyra_petsc.terms.stretch_limit import StretchLimit

SOFT = {
    "density": 0.15,
    "membrane": {"c11": 60.0, "c22": 60.0, "c12": 10.0, "c33": 20.0},
    "bending": 1e-5,
    "damping": 0.01,
}
"""A fabric that stretches by a third where it hangs by two corners."""

LIMIT = 1.05
TOP, BOTTOM = list(range(72, 81)), list(range(9))
PULL = {"up": [{"time": 0.0}, {"time": 1.0, "translate": [0.0, 0.2, 0.0]}]}


def hanging(scheme: str, limit: float | None = LIMIT, **more: Any) -> dict[str, Any]:
    """A sheet held at two corners that falls, or at one side under its weight in statics."""
    material = SOFT | ({} if limit is None else {"stretch_limit": limit})
    content = {"mesh": grid(1.0, 1.0, 8, 8, "alternating"), "material": material}
    if scheme == "static":
        time: dict[str, Any] = {"analysis": "static", "step": 0.5}
        return content | {"handles": [{"nodes": TOP}], "gravity": [0.0, -20.0, 0.0], "time": time} | more
    time = {"end": 0.5, "step": 0.01, "integrator": scheme}
    handles = [{"nodes": [TOP[0], TOP[-1]]}]
    return content | {"handles": handles, "gravity": [0.0, 0.0, -9.81], "time": time} | more


def limits(simulation: SteppedScene) -> StretchLimit:
    term = simulation.problem.terms["stretch_limit"]
    assert isinstance(term, StretchLimit)
    return term


def largest(simulation: SteppedScene) -> float:
    """Largest principal stretch of the whole sheet."""
    term, x = limits(simulation), simulation.problem.equations.x
    found = float(term._largest(x).max(initial=0.0))
    return float(simulation.comm.allreduce(found, MPI.MAX))


def run(simulation: SteppedScene) -> tuple[int, list[float]]:
    """Newton's iterations, and the largest stretch after every step."""
    iterations, stretches = 0, []
    while not simulation.finished:
        iterations += simulation.step().newton_iterations
        if "stretch_limit" in simulation.problem.terms:
            stretches.append(largest(simulation))
    return iterations, stretches


@contextmanager
def pulled(comm: MPI.Comm, scheme: str) -> Iterator[SteppedScene]:
    """A sheet whose sides are pulled apart by 20 %."""
    handles = [{"nodes": BOTTOM}, {"nodes": TOP, "motion": "up"}]
    content = hanging(scheme, handles=handles, motions=PULL, gravity=[0.0, 0.0, 0.0])
    if scheme != "static":
        content["time"] = {"end": 1.0, "step": 0.02, "integrator": scheme}
    with stepped(comm, content) as simulation:
        yield simulation


@pytest.mark.parametrize("scheme", [*INTEGRATORS, "static"])
def test_no_step_exceeds_the_limit(scheme: str) -> None:
    with stepped(MPI.COMM_SELF, hanging(scheme)) as simulation:
        _, stretches = run(simulation)
        near = LIMIT - 0.5 * (LIMIT - 1.0)
        assert near < max(stretches) < LIMIT
        if scheme != "static":  # steps near the limit iterate, with their stage at the end of the step
            iterating = {"semi-implicit": "beuler", "midpoint": "bdf2", "alpha2": "bdf2"}
            assert simulation.last_integrator.name == iterating.get(scheme, scheme)
        account = simulation.energy_balance.budget
        assert account.membrane > 0.0


def test_a_limit_costs_at_most_half_as_many_iterations_again() -> None:
    counts = []
    for limit in (None, LIMIT):
        with stepped(MPI.COMM_SELF, hanging("beuler", limit)) as simulation:
            counts.append(run(simulation)[0])
    assert counts[1] <= 1.5 * counts[0]


@pytest.mark.parametrize("scheme", ["semi-implicit", "midpoint"])
def test_with_contact(scheme: str) -> None:
    floor = {"plane": {"point": [0.0, 0.0, -0.2], "normal": [0.0, 0.0, 1.0]}}
    more = {"contact": {"gap": 0.02}, "obstacles": {"floor": floor}}
    with stepped(MPI.COMM_SELF, hanging(scheme, **more)) as simulation:
        _, stretches = run(simulation)
        assert max(stretches) < LIMIT
        assert simulation.energy_balance.columns()["contacts"] > 0


@pytest.mark.parallel
def test_the_result_is_that_of_one_rank(comm: MPI.Comm) -> None:
    content = hanging("semi-implicit", petsc={"ksp_rtol": 1e-10})
    content["time"]["end"] = 0.25
    with stepped(comm, content) as simulation:
        stretches = run(simulation)[1]
        found = gathered(simulation.problem.points, simulation.problem.equations.x)
    with stepped(MPI.COMM_SELF, content) as simulation:
        assert run(simulation)[1] == pytest.approx(stretches, rel=1e-6)
        alone = gathered(simulation.problem.points, simulation.problem.equations.x)
    np.testing.assert_allclose(found, alone, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("scheme", ["beuler", "midpoint", "static"])
def test_what_handles_force_beyond_it_ends_in_words(scheme: str) -> None:
    with pulled(MPI.COMM_SELF, scheme) as simulation:
        beyond = r"would stretch the sheet beyond material\.stretch_limit.*try a shorter motion"
        with pytest.raises(SolverError, match=beyond):
            run(simulation)
        assert 0.99 * LIMIT < largest(simulation) < LIMIT


def test_a_start_beyond_the_limit_is_refused() -> None:
    content = hanging("beuler", 1.001, initial={"noise": 0.02, "seed": 1})
    with (
        pytest.raises(InputError, match=r"at the start triangle \d+ is stretched to 1\.\d+ times"),
        stepped(MPI.COMM_SELF, content),
    ):
        pass


def test_groups_have_limits_of_their_own() -> None:
    sheets = [grid(1.0, 1.0, 4, 4) | {"name": name} for name in ("soft", "limited", "tight")]
    for number, sheet in enumerate(sheets):
        sheet["transform"] = {"translate": [2.0 * number, 0.0, 0.0]}
    material = [
        SOFT | {"group": "soft"},
        SOFT | {"group": "limited", "stretch_limit": 1.1},
        SOFT | {"group": "tight", "stretch_limit": 1.02},
    ]
    tops = [{"nodes": [20 + 25 * number, 24 + 25 * number]} for number in range(3)]
    content = hanging("bdf2") | {"mesh": sheets, "material": material, "handles": tops}
    with stepped(MPI.COMM_SELF, content) as simulation:
        run(simulation)
        term, x = limits(simulation), simulation.problem.equations.x
        assert term.n_elements == 64
        stretch, limit = term._largest(x), term.elements.data["limit"]
        for value in (1.1, 1.02):
            assert 0.5 * (1.0 + value) < stretch[limit == value].max() < value


@pytest.mark.parametrize("limit", [1.0, 0.9, -1, "much"])
def test_a_limit_that_is_none_is_refused(limit: Any) -> None:
    with pytest.raises(ValueError, match="stretch_limit"):
        scene_of(hanging("beuler", limit))
