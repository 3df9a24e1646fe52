"""Seams: which vertices they hold together, their work, and that contact leaves out these alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, finished, scene_of, shape, stepped

import lyra_petsc
from lyra_petsc.contact.joined import crossings_beside_seams
from lyra_petsc.errors import InputError
from lyra_petsc.mesh.build import build_scene_mesh
from lyra_petsc.mesh.seams import sewn_curves
from lyra_petsc.terms.seam import SeamThreads

pytestmark = [pytest.mark.parallel]


def panels(n_front: int, n_back: int, gap: float, seam: dict[str, Any], **more: Any) -> dict[str, Any]:
    """Two square panels of 0.2 m beside each other, sewn along their near sides."""
    grids = [{"grid": {"width": 0.2, "height": 0.2, "nx": n, "ny": n}} for n in (n_front, n_back)]
    return {
        "mesh": [
            grids[0] | {"name": "front"},
            grids[1] | {"name": "back", "transform": {"translate": [0.2 + gap, 0.0, 0.0]}},
        ],
        "material": CLOTH,
        "seams": [{"between": ["front/right", "back/left"]} | seam],
        "time": {"end": 0.1, "step": 0.01},
    } | more


@pytest.mark.parametrize(
    ("seam", "words"),
    [
        ({"between": ["front/right", "front/right"]}, "two groups"),
        ({"between": ["front/right", "front"]}, "surface group without edges"),
        ({"between": ["right", "back/left"]}, "2 curves, not one; name the sheet"),
        ({"between": ["front/rigt", "back/left"]}, "front/right"),
        ({"start": [0, 0, 0]}, "for closed curves"),
        ({"close": {"from": 1, "until": 1}}, "later than from"),
        ({"stiffness": -1}, "> 0"),
    ],
)
def test_what_cannot_be_sewn_is_refused(seam: dict[str, Any], words: str) -> None:
    with pytest.raises((InputError, ValueError), match=words):
        build_scene_mesh(scene_of(panels(2, 2, 0.01, seam)))


def test_stitches_are_told_that_they_are_seams() -> None:
    with pytest.raises((InputError, ValueError), match=r"seams: \[\{between"):
        scene_of(panels(2, 2, 0.0, {}) | {"stitches": [{"from": "front", "to": "back"}]})


def test_vertices_are_tied_where_the_rest_lengths_agree() -> None:
    scene = scene_of(panels(7, 11, 0.01, {}))
    mesh = build_scene_mesh(scene)
    (sewn,) = sewn_curves(scene, mesh)
    ties = sewn.ties
    assert sewn.tied == 1
    assert len(ties.stencil) == 12
    assert ties.share.sum() == pytest.approx(0.2)
    np.testing.assert_allclose(ties.gaps(mesh.positions), np.tile([0.01, 0.0, 0.0], (12, 1)), atol=1e-12)
    reverse = scene_of(panels(7, 11, 0.01, {"reverse": True}))
    gaps = sewn_curves(reverse, build_scene_mesh(reverse))[0].ties.gaps(mesh.positions)
    np.testing.assert_allclose(np.sort(gaps[:, 1]), np.linspace(-0.2, 0.2, 12), atol=1e-12)


def test_coincident_vertices_become_one() -> None:
    mesh = build_scene_mesh(scene_of(panels(4, 4, 0.0, {})))
    assert mesh.n_vertices == 45
    assert len(mesh.tied) == len(mesh.coincident) == 0
    assert [source.n_vertices for source in mesh.sources] == [25, 20]
    assert mesh.groups["front/right"].vertices.tolist() == mesh.groups["back/left"].vertices.tolist()


CLOSING = {"close": {"from": 0.0, "until": 0.05}}
HANGING = {"gravity": [0, 0, -9.81], "handles": [{"group": "front/left"}]}


@pytest.mark.parametrize("integrator", ["beuler", "semi-implicit", "midpoint", "alpha2", "bdf2"])
def test_a_seam_closes_and_stays_closed(comm: MPI.Comm, integrator: str) -> None:
    content = panels(4, 6, 0.01, CLOSING, **HANGING)
    content["time"] = content["time"] | {"integrator": integrator}
    with finished(comm, content) as simulation:
        term = simulation.problem.terms["seam"]
        assert isinstance(term, SeamThreads)
        here = simulation.problem.equations.here()
        ((_, gap, *_),) = term.table_rows(here.x, here.frozen[term])
        assert gap < 1e-4 * 0.2 / 6


def test_the_work_of_the_threads_is_that_of_their_tension(comm: MPI.Comm) -> None:
    """Two panels pulled together slowly against soft springs: work is what the springs store."""
    held = [{"group": "front/left", "stiffness": 5.0}, {"group": "back/right", "stiffness": 5.0}]
    content = panels(3, 3, 0.02, {"close": {"until": 0.8}}, handles=held)
    content["time"] = {"analysis": "static", "step": 0.1}
    with finished(comm, content) as simulation:
        budget = simulation.budget
        assert budget.external_work == pytest.approx(budget.elastic, rel=0.02)
        assert budget.elastic > 0.0


def test_crossings_at_a_seam_are_told_from_others() -> None:
    """Two triangles overlap at their seam by a thousandth of an edge; then one passes the other."""
    points = np.array(
        [[0, 0, 0], [1, 0, 0], [0.5, 1, 0.0], [0, 1e-3, -1e-3], [1, 1e-3, 1e-3], [0.5, -1, 0.1]]
    )
    triangles, tied = np.array([[0, 1, 2], [4, 3, 5]]), np.array([[3, 0], [4, 1]])
    assert len(crossings_beside_seams(points, triangles, tied[:0])) == 1
    assert len(crossings_beside_seams(points, triangles, tied)) == 0
    through = points + [[0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0.5, -0.5], [0, 0.5, -0.5], [0, 1.5, 0.5]]
    assert len(crossings_beside_seams(through, triangles, tied)) == 1


def test_panels_fold_onto_each_other_with_contact(comm: MPI.Comm) -> None:
    turn = [{"time": 0}, {"time": 0.3, "rotate": {"axis": [0, 1, 0], "degrees": -172}}]
    content = panels(
        4,
        5,
        0.0,
        {},
        contact={"gap": 0.005},
        handles=[{"group": "front"}, {"group": "back/right", "motion": "fold"}],
        motions={"fold": turn},
    )
    for sheet, x in zip(content["mesh"], (-0.2, 0.0), strict=True):  # the seam is the axis
        sheet["transform"] = {"translate": [x, 0, 0]}
    content["time"] = {"end": 0.3, "step": 0.01}
    with finished(comm, content) as simulation:
        x = shape(simulation)
        mesh = build_scene_mesh(scene_of(content))
        assert len(crossings_beside_seams(x, mesh.triangles, mesh.tied)) == 0
        back = x[mesh.groups["back/right"].vertices]
        assert (back[:, 0] < -0.15).all()
        assert simulation.energy_balance.columns()["contacts"] > 0


def test_sides_of_a_closing_seam_do_not_pass_each_other(comm: MPI.Comm) -> None:
    """Two panels above each other are sewn along their near sides, which swing towards each other."""
    content = panels(5, 6, 0.05, {"close": {"until": 0.2}}, contact={"gap": 0.01})
    content["mesh"][1]["transform"] = {"translate": [0.15, 0.0, 0.05]}
    content["time"] = {"end": 0.3, "step": 0.005}
    mesh = build_scene_mesh(scene_of(content))
    with stepped(comm, scene_of(content)) as simulation:
        while not simulation.finished:
            simulation.step()
            closed = simulation.time > 0.2 - 1e-9
            tied = mesh.tied if closed else mesh.tied[:0]
            assert len(crossings_beside_seams(shape(simulation), mesh.triangles, tied)) == 0
        term, here = simulation.problem.terms["seam"], simulation.problem.equations.here()
        assert isinstance(term, SeamThreads)
        ((_, gap, *_),) = term.table_rows(here.x, here.frozen[term])
    assert gap < 1e-4 * 0.2 / 6


def test_corners_that_meet_through_other_seams_do_not_repel_each_other(comm: MPI.Comm) -> None:
    """Four squares around a corner, each sewn to two others."""
    places = {"a": (0.0, 0.0), "b": (0.21, 0.0), "c": (0.0, 0.21), "d": (0.21, 0.21)}
    content = panels(4, 4, 0.0, {}, contact={"gap": 0.01})
    grid = content["mesh"][0]["grid"]
    content["mesh"] = [
        {"name": name, "grid": grid, "transform": {"translate": [*at, 0.0]}} for name, at in places.items()
    ]
    sides = ("a/right", "b/left"), ("a/top", "c/bottom"), ("b/top", "d/bottom"), ("c/right", "d/left")
    content["seams"] = [{"between": pair} | CLOSING for pair in sides]
    with finished(comm, content) as simulation:
        term, here = simulation.problem.terms["seam"], simulation.problem.equations.here()
        assert isinstance(term, SeamThreads)
        gaps = [row[1] for row in term.table_rows(here.x, here.frozen[term])]
        assert max(map(float, gaps)) < 1e-4 * 0.2 / 4
        assert simulation.energy_balance.columns()["contacts"] == 0


@pytest.mark.parametrize("stiffness", ["rigid", 1e4])
def test_forces_in_a_seam_are_the_pull_of_a_peel_test(stiffness: float | str, shared_tmp: Path) -> None:
    """Two strips on each other, sewn along one side, pulled apart there by their other sides."""
    pull = [{"time": 0}, {"time": 1, "translate": [0.0, 0.0, 0.41]}]
    content = panels(3, 4, 0.0, {"stiffness": stiffness, "between": ["front/right", "back/right"]})
    content["mesh"][1]["transform"] = {"translate": [0.0, 0.0, 1e-3]}
    content |= {
        "handles": [{"group": "front/left"}, {"group": "back/left", "motion": "pull"}],
        "motions": {"pull": pull},
        "time": {"analysis": "static", "step": 0.25},
        "output": {"reactions": True, "every": None},
    }
    run = lyra_petsc.run(scene_of(content), shared_tmp / "out")
    last, reactions = run.seams.iloc[-1], run.reactions.iloc[-1]
    force = np.array([last["fx"], last["fy"], last["fz"]])
    # the seam pulls the first panel as the second handle pulls the second one
    pulled = np.array([reactions[f"handle1_{axis}"] for axis in "xyz"])
    np.testing.assert_allclose(force, pulled, rtol=0, atol=1e-5 * np.linalg.norm(pulled))
    assert np.linalg.norm(force) > 1.0
    assert last["opening"] >= 0.99 * np.linalg.norm(force)
    if stiffness == "rigid":
        assert last["gap"] < 1e-4 * 0.2 / 4
    else:
        assert last["gap"] * 1e4 * 0.2 == pytest.approx(last["opening"], rel=0.3)
