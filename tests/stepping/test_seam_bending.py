"""Bending across seams: angles, their stiffness, models, ranks, and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import finished, scene_of, shape, stepped

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError
from lyra_petsc.stepping.simulation import SteppedScene

pytestmark = [pytest.mark.parallel]

MEMBRANE = {"c11": 1e4, "c22": 1e4, "c12": 0.0, "c33": 5e3}
MODELS = ("hinge", "midedge")
WIDTH, LENGTH = 0.5, 0.25
"""Of the panels along the seam and across it [m]."""

JOINED, TIED = (2, 2), (2, 3)
"""Numbers of edges of both sides: equal ones become one, others are tied."""


def sewn(
    edges: tuple[int, int], seam: dict[str, Any], model: str = "hinge", turned: float = 0.0, gap: float = 0.0
) -> dict[str, Any]:
    """Two panels beside each other, sewn, the second one turned upwards [°]; the first one is held."""
    grids = [{"grid": {"width": LENGTH, "height": WIDTH, "nx": 1, "ny": n}} for n in edges]
    first = {"translate": [-LENGTH, 0.0, 0.0]}
    place = {"translate": [gap, 0.0, 0.0], "rotate": {"axis": [0, 1, 0], "degrees": -turned}}
    return {
        "mesh": [
            grids[0] | {"name": "one", "transform": first},
            grids[1] | {"name": "two", "transform": place},
        ],
        "material": {"density": 0.2, "membrane": MEMBRANE, "bending": 0.01, "bending_model": model},
        "handles": [{"group": "one"}],
        "seams": [{"between": ["one/right", "two/left"]} | seam],
        "time": {"analysis": "static", "step": 0.25},
    }


def fold(x: Array) -> float:
    """Angle [°] from flat of the second panel, by the last vertex, which is far from the seam at x = 0."""
    return float(np.degrees(np.arctan2(x[-1, 2], x[-1, 0])))


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("edges", [JOINED, TIED])
@pytest.mark.parametrize(("angle", "bending"), [(40.0, None), (-70.0, 2e-3)])
def test_panels_take_their_angle(
    comm: MPI.Comm, model: str, edges: tuple[int, int], angle: float, bending: float | None
) -> None:
    seam = {"angle": angle} | ({} if bending is None else {"bending": bending})
    with finished(comm, sewn(edges, seam, model)) as simulation:
        assert fold(shape(simulation)) == pytest.approx(angle, abs=1e-5)
        assert abs(simulation.budget.total) < 1e-10


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("edges", [JOINED, TIED])
@pytest.mark.parametrize("start", [0.0, 50.0])
def test_the_angle_of_the_start_is_kept(
    comm: MPI.Comm, model: str, edges: tuple[int, int], start: float
) -> None:
    with finished(comm, sewn(edges, {"angle": "rest"}, model, turned=start)) as simulation:
        assert fold(shape(simulation)) == pytest.approx(start, abs=1e-6)
        assert abs(simulation.budget.total) < 1e-12


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("edges", [JOINED, TIED])
def test_a_seam_opens_under_a_moment_by_its_stiffness(
    comm: MPI.Comm, model: str, edges: tuple[int, int]
) -> None:
    # a force F on the end of a rigid arm L: 2 B W / (h0 + h1) (θ - 20°) = F L cos θ
    stiffness, force, start = 0.025, 0.1, np.radians(20.0)
    content = sewn(edges, {"angle": 20.0, "bending": stiffness}, model, turned=20.0)
    content["material"] |= {
        "membrane": {name: 100.0 * value for name, value in MEMBRANE.items()},
        "bending": 1e4,
    }
    content["loads"] = [{"group": "two/right", "force": [0.0, 0.0, force]}]
    with finished(comm, content) as simulation:
        theta = np.radians(fold(shape(simulation)))
        assert simulation.budget.bending == pytest.approx(
            stiffness * WIDTH / (2.0 * LENGTH) * (theta - start) ** 2, rel=1e-3
        )
    assert theta > start + 0.1
    moment = stiffness * WIDTH / LENGTH * (theta - start)
    assert moment == pytest.approx(force * LENGTH * np.cos(theta), rel=1e-3)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("edges", [2, 3])
def test_each_seam_of_three_panels_bends_its_own_two(comm: MPI.Comm, model: str, edges: int) -> None:
    # the third panel stands up, and is sewn to the second one alone
    content = sewn((2, 2), {"angle": 20.0, "bending": 0.01}, model)
    grid = {"width": LENGTH, "height": WIDTH, "nx": 1, "ny": edges}
    upright = {"rotate": {"axis": [0, 1, 0], "degrees": -90}}
    content["mesh"].append({"name": "three", "grid": grid, "transform": upright})
    content["seams"].append({"between": ["two/left", "three/left"], "angle": -50.0, "bending": 0.01})
    with finished(comm, content) as simulation:
        x = shape(simulation)
    second, third = (np.degrees(np.arctan2(x[n, 2], x[n, 0])) for n in (11, -1))
    assert second == pytest.approx(20.0, abs=1e-4)
    assert third == pytest.approx(20.0 + 180.0 + 50.0 - 360.0, abs=1e-4)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("edges", [JOINED, TIED])
def test_seams_bend_freely_by_default_and_joined_ones_like_the_sheet_else(
    comm: MPI.Comm, model: str, edges: tuple[int, int]
) -> None:
    held = [{"group": "one"}, {"group": "two", "motion": "turn"}]
    rotate = {"axis": [0, 1, 0], "degrees": -30.0}
    change = {"handles": held, "motions": {"turn": [{"time": 0}, {"time": 1, "rotate": rotate}]}}
    energies = []
    for seam in ({}, {"angle": "rest"}):
        with finished(comm, sewn(edges, seam, model) | change) as simulation:
            energies.append(simulation.budget.bending)
    assert energies[0] == pytest.approx(0.0, abs=1e-14)
    # κ = θ/L between the middles of the triangles
    assert energies[1] == pytest.approx(0.5 * 0.01 * WIDTH / LENGTH * np.radians(30.0) ** 2, rel=0.2)


def test_degrees_are_towards_the_normals_of_the_first_side(comm: MPI.Comm) -> None:
    """The panel with more edges has normals downwards, whichever side it is."""
    for between, angle in ((("one/right", "two/left"), 35.0), (("two/left", "one/right"), -35.0)):
        content = sewn(TIED, {"between": list(between), "angle": 35.0, "bending": 1e-3})
        content["mesh"][1]["transform"] = {
            "translate": [0.0, WIDTH, 0.0],
            "rotate": {"axis": [1, 0, 0], "degrees": 180.0},
        }
        with finished(comm, content) as simulation:
            assert fold(shape(simulation)) == pytest.approx(angle, abs=1e-5)


def test_bending_that_begins_does_the_work_that_is_stored(comm: MPI.Comm) -> None:
    """Both panels are held flat beside each other while the seam closes."""
    content = sewn(TIED, {"angle": 60.0, "bending": 5e-3, "close": {"until": 1.0}}, gap=0.02)
    content["handles"].append({"group": "two"})
    with stepped(comm, content) as simulation:
        stored = 5e-3 * WIDTH / (2.0 * LENGTH) * np.radians(60.0) ** 2
        begun = (1.0 - 0.02 / (2.0 * LENGTH)) ** 2
        assert simulation.budget.bending == pytest.approx(stored * begun, rel=1e-12)
        while not simulation.finished:
            simulation.step()
        budget = simulation.budget
        assert budget.bending == pytest.approx(stored, rel=1e-12)
        assert budget.external_work == pytest.approx(budget.total - stored * begun, rel=1e-9)


@pytest.mark.parametrize("integrator", ["beuler", "semi-implicit", "midpoint", "alpha2", "bdf2"])
def test_sides_bend_towards_their_angle_while_the_seam_closes(comm: MPI.Comm, integrator: str) -> None:
    seam = {"angle": 60.0, "bending": 5e-3, "close": {"until": 0.2}}
    content = sewn(TIED, seam, gap=0.02)
    content["time"] = {"end": 0.4, "step": 0.005, "integrator": integrator}
    content["material"]["damping"] = 0.02
    with stepped(comm, content) as simulation:
        start = simulation.budget.total
        while not simulation.finished:
            simulation.step()
        budget = simulation.budget
        assert 20.0 < fold(shape(simulation)) < 60.0
        assert start + budget.external_work - budget.dissipation - budget.total > 0.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"angle": "flat"}, "must be free, rest or a number"),
        ({"angle": 180.0}, "between -180 and 180"),
        ({"bending": 1e-3}, "needs angle: rest, or degrees"),
        ({"angle": 10.0, "bending": -1.0}, "greater than or equal to 0|>= 0"),
    ],
)
def test_what_has_no_meaning_is_refused(change: dict[str, Any], words: str) -> None:
    with pytest.raises((InputError, ValueError), match=words):
        scene_of(sewn(JOINED, change))


def test_a_start_folded_by_half_a_turn_needs_degrees() -> None:
    content = sewn(TIED, {"angle": "rest"}, turned=180.0)
    with pytest.raises(InputError, match="folded by 180° at the seam, to an unknown side; give degrees"):
        SteppedScene(MPI.COMM_SELF, scene_of(content))


def test_an_edge_in_a_seam_with_an_angle_and_in_a_crease_is_refused() -> None:
    crease = {"group": "one/right", "angle": 10.0, "stiffness": 1e-3}
    for angle, refused in (("free", False), ("rest", True), (20.0, True)):
        scene = scene_of(sewn(JOINED, {"angle": angle}) | {"creases": [crease]})
        if refused:
            with pytest.raises(InputError, match="in the crease 'one/right', too"):
                SteppedScene(MPI.COMM_SELF, scene)
        else:
            SteppedScene(MPI.COMM_SELF, scene).destroy()
