"""Attachments: what they hold, at which force they break, and what a run says of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from oracle import differences, gradient
from physics import CLOTH, Simulation, finished, grid, scene_of, shape, stepped
from pydantic import ValidationError

from lyra_petsc.errors import InputError, SolverError
from lyra_petsc.mesh.attached_points import attached_points
from lyra_petsc.mesh.build import build_scene_mesh
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.output.recorder import Recorder
from lyra_petsc.scene.schema import INTEGRATORS
from lyra_petsc.terms.attachments import AttachmentSprings

SOLVER = {"pc_type": "lu", "ksp_rtol": 1e-12}
SIDE = 0.2
DENSITY = 0.5  # kg/m²
PLACE = [0.15, 0.13, -0.1]  # inside a triangle of the lower plate
TOP = {"group": "top"}
WEIGHT = DENSITY * SIDE**2 * 10.0  # N


def sheet(name: str, height: float = 0.0) -> dict[str, Any]:
    return grid(SIDE, SIDE, 2, 2) | {"name": name, "transform": {"translate": [0.0, 0.0, height]}}


def hanging(**attachment: Any) -> dict[str, Any]:
    """A plate that hangs by one spring on another one, which is held."""
    return {
        "mesh": [sheet("top"), sheet("bottom", -0.1)],
        "material": CLOTH | {"density": DENSITY, "bending": 10.0},
        "gravity": [0.0, 0.0, -10.0],
        "handles": [
            {"group": "top"},
            {"nodes": [13], "axes": ["x", "y"]},  # its middle
            {"nodes": [14], "axes": ["y"]},
        ],
        "attachments": [
            {"from": {"nodes": [13]}, "to": {"group": "top"}, "stiffness": 40.0, "length": "start"}
            | attachment
        ],
        "solver": {"force_tolerance": 1e-10},
        "time": {"analysis": "static", "step": 0.25},
    }


def springs(simulation: Any) -> AttachmentSprings:
    term = simulation.problem.terms["attachments"]
    assert isinstance(term, AttachmentSprings)
    return term


def test_a_hanging_plate_pulls_with_its_weight() -> None:
    with finished(MPI.COMM_SELF, hanging(), **SOLVER) as simulation:
        x = shape(simulation)
        assert x[4, 2] - x[13, 2] - 0.1 == pytest.approx(WEIGHT / 40.0, rel=1e-8)
        energy = simulation.budget.more["attachment_energy"]
        assert energy == pytest.approx(0.5 * WEIGHT**2 / 40.0, rel=1e-8)
        rows = springs(simulation).table_rows(simulation.problem.equations.x)
        name, holding, distance, *force = rows[0]
        assert (name, holding) == ("attachment0", 1.0)
        assert distance == pytest.approx(0.1 + WEIGHT / 40.0, rel=1e-8)
        np.testing.assert_allclose(force, [0.0, 0.0, WEIGHT, WEIGHT], atol=1e-8)
        assert not any("nothing holds" in note for note in simulation.notes)


@pytest.mark.parametrize("factor", [0.99, 1.01])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_spring_breaks_at_its_force(integrator: str, factor: float) -> None:
    scene = pulled(integrator, factor)
    with finished(MPI.COMM_SELF, scene, **SOLVER) as simulation:
        broken = [note for note in simulation.notes if "attachments[0] breaks at" in note]
        assert len(broken) == (factor < 1.0)
        assert springs(simulation).broken.tolist() == [float(factor < 1.0)]
        energy = simulation.budget.more["attachment_energy"]
        assert (energy == 0.0) == (factor < 1.0)


def pulled(integrator: str, factor: float) -> dict[str, Any]:
    """One plate is held, and the other one pulled away from it by 0.01 m: a force of 0.4 N."""
    return hanging(breaks_at=0.4 * factor) | {
        "gravity": [0.0, 0.0, 0.0],
        "handles": [{"group": "top"}, {"group": "bottom", "motion": "down"}],
        "motions": {"down": [{"time": 0}, {"time": 0.1, "translate": [0, 0, -0.01]}]},
        "time": {"end": 0.1, "step": 0.01, "integrator": integrator},
    }


@pytest.mark.parallel
@pytest.mark.parametrize("breaks_at", [0.5 * 1.01, 0.5 * 0.99, 0.25])
def test_load_goes_to_what_is_whole_in_statics(comm: MPI.Comm, breaks_at: float) -> None:
    """Of two springs under a plate of half the weight each, one breaks under the last load or before."""
    scene = hanging()
    places = [{"nodes": [12]}, {"nodes": [14]}]
    scene["attachments"] = [
        {"from": place, "to": TOP, "stiffness": 40.0, "length": "start"} for place in places
    ]
    scene["attachments"][0]["breaks_at"] = breaks_at * WEIGHT
    scene["handles"] = [{"group": "top"}, {"group": "bottom", "axes": ["x", "y"]}]
    with finished(comm, scene, **SOLVER) as simulation:
        x, holds = simulation.problem.equations.x, breaks_at > 0.5
        first, second = springs(simulation).table_rows(x)
        assert (first[1], second[1]) == (float(holds), 1.0)
        np.testing.assert_allclose(
            [first[-1], second[-1]], np.array([0.5, 0.5] if holds else [0, 1]) * WEIGHT, rtol=1e-6
        )


def test_what_falls_after_a_break_ends_a_static_analysis_in_words() -> None:
    scene = hanging(breaks_at=0.99 * WEIGHT)
    message = r"load factor 1\) did not converge after what has broken"
    with pytest.raises(SolverError, match=message), finished(MPI.COMM_SELF, scene, **SOLVER):
        pass


def test_the_energy_of_a_broken_spring_is_heat() -> None:
    scene = pulled("beuler", 0.6)
    scene["time"]["step"] = 5e-4
    with finished(MPI.COMM_SELF, scene, **SOLVER) as simulation:
        at = float(next(n for n in simulation.notes if "breaks at" in n).split()[-2])
        assert at == pytest.approx(0.24, rel=0.02)
        heat = 0.5 * at**2 / 40.0
        assert simulation.budget.dissipation == pytest.approx(heat, rel=1e-3)
        assert simulation.budget.external_work == pytest.approx(heat, rel=0.02)


def test_derivatives_without_length_and_beyond_it(tmp_path: Path) -> None:
    one = {
        "from": {"nodes": [0, 1]},
        "to": {"point": [0.15, 0.13, -0.1], "group": "bottom"},
        "stiffness": 5.0,
    }
    other = one | {"from": {"nodes": [2]}, "length": 0.3}
    content = hanging() | {"attachments": [one, other], "time": {"end": 1.0, "step": 0.1}}
    with Simulation(content, MPI.COMM_SELF) as simulation:
        term, x = simulation.problem.terms["attachments"], simulation.equations.x.copy()
        x += np.random.default_rng(3).uniform(-0.05, 0.05, x.shape)
        assert term.stencil.shape == (3, 4)
        slope = differences(lambda at: term.energies(at, None).sum(), x, 1e-5)
        np.testing.assert_allclose(gradient(term, x, None), slope, atol=1e-8)
        blocks = np.empty((3, 4, 4, 3, 3))
        term.hessians(x, None, 0, 3, 0.0, blocks)
        dense = np.zeros((len(x), 3, len(x), 3))
        for stencil, block in zip(term.stencil, blocks, strict=True):
            dense[stencil[:, None], :, stencil[None, :]] += block
        step = np.random.default_rng(4).normal(size=x.shape)
        change = (gradient(term, x + 1e-6 * step, None) - gradient(term, x - 1e-6 * step, None)) / 2e-6
        np.testing.assert_allclose(np.einsum("aibj,bj->ai", dense, step), change, atol=1e-6)
        term.hessians(x, None, 0, 3, 1.0, blocks)
        for block in blocks:
            assert np.linalg.eigvalsh(block.transpose(0, 2, 1, 3).reshape(12, 12)).min() > -1e-10


def test_ends_are_the_nearest_points_at_the_start() -> None:
    def ends(start: dict[str, Any], to: dict[str, Any]) -> Any:
        scene = scene_of(hanging() | {"attachments": [{"from": start, "to": to, "stiffness": 1.0}]})
        return attached_points(scene, build_scene_mesh(scene))[0]

    vertices, weights, distance = ends({"nodes": [9, 10]}, {"group": "top"})
    assert [v.tolist() for v in vertices] == [[0, 9], [1, 10]]
    assert [w.tolist() for w in weights] == [[-1.0, 1.0]] * 2
    np.testing.assert_allclose(distance, 0.1)
    vertices, weights, distance = ends({"nodes": [9]}, {"point": [0.15, 0.125, 0.03], "group": "top"})
    assert vertices[0].tolist() == [4, 5, 8, 9]  # inside triangle 4-5-8 of the held plate
    np.testing.assert_allclose(weights[0], [-0.5, -0.25, -0.25, 1.0])
    np.testing.assert_allclose(distance, [np.linalg.norm([0.15, 0.125, 0.1])])
    vertices, weights, _ = ends({"nodes": [0]}, {"nodes": [17, 16]})
    assert vertices[0].tolist() == [0, 16]
    vertices, weights, distance = ends({"point": [0.3, 0.05, 0.0]}, {"group": "bottom"})  # beside an edge
    assert vertices[0].tolist() == [2, 5, 11, 14]
    np.testing.assert_allclose(weights[0], [0.5, 0.5, -0.5, -0.5])
    np.testing.assert_allclose(distance, [0.1])


@pytest.mark.parametrize(
    ("attachment", "message"),
    [
        ({"from": {"group": "tap"}}, r"attachments\[0\]\.from\.group: no group 'tap'"),
        (
            {"to": {"nodes": [13]}},
            r"attachments\[0\]\.to: .* vertex 13 would be attached to itself",
        ),
        ({"to": {"group": "left", "point": [0, 0, 0]}}, r"attachments\[0\]\.to\.group: .* has no triangles"),
    ],
)
def test_ends_that_are_no_points_are_refused(attachment: dict[str, Any], message: str) -> None:
    scene = scene_of(hanging(**attachment))
    with pytest.raises(InputError, match=message):
        attached_points(scene, build_scene_mesh(scene))


@pytest.mark.parametrize(
    ("attachment", "message"),
    [
        ({"from": {}}, "must have exactly one of group, nodes, box, point"),
        ({"to": {"point": [0, 0, 0], "nodes": [1]}}, "does not go with point"),
        ({"stiffness": 0}, "greater than 0|must be > 0"),
        ({"length": -1}, "must be >= 0"),
        ({"length": "rest"}, "must be a length in m, or start"),
    ],
)
def test_bad_values_are_refused(attachment: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        scene_of(hanging(**attachment))


def test_a_spring_that_is_broken_at_the_start_is_refused() -> None:
    scene = scene_of(hanging(length=0, breaks_at=3.9))
    message = r"attachments\[0\]\.breaks_at: must be above the force of the start, 4 N"
    with pytest.raises(InputError, match=message), finished(MPI.COMM_SELF, scene, **SOLVER):
        pass


def test_points_are_attached_once() -> None:
    scene = hanging()
    scene |= {"attachments": 2 * scene["attachments"]}
    message = r"attachments\[1\]: joins points that attachments\[0\] joins, too"
    with pytest.raises(InputError, match=message), stepped(MPI.COMM_SELF, scene):
        pass


@pytest.mark.parallel
def test_a_resumed_run_has_the_same_springs(comm: MPI.Comm, shared_tmp: Path) -> None:
    first = {"from": {"nodes": [9, 10, 11]}, "to": TOP, "stiffness": 40.0, "breaks_at": 0.2}
    second = {
        "from": {"nodes": [15, 16]},
        "to": {"point": [0.1, 0.1, 0.0], "group": "top"},
        "stiffness": 20.0,
    }
    content = pulled("bdf2", 1.0) | {
        "attachments": [first | {"length": "start"}, second],
        "handles": [{"group": "top"}, {"nodes": [9], "motion": "down"}],
        "time": {"end": 0.1, "step": 0.01, "integrator": "bdf2"},
    }
    with finished(comm, content, **SOLVER) as simulation:
        expected, notes = shape(simulation), [n for n in simulation.notes if "breaks" in n]
    assert len(notes) == 1
    folder = shared_tmp / "run"
    if comm.rank == 0:
        folder.mkdir()
    comm.Barrier()
    with stepped(comm, scene_of(content), **SOLVER) as simulation:
        recorder = Recorder(simulation)
        recorder.begin(folder)
        while not any("breaks" in note for note in simulation.notes):
            recorder.record(simulation.step())
        recorder.write_checkpoint()
        recorder.flush()
        recorder.close()
    with stepped(comm, scene_of(content), **SOLVER) as simulation:
        recorder = Recorder(simulation)
        recorder.resume(folder)
        while not simulation.finished:
            recorder.record(simulation.step())
        recorder.close()
        assert [n for n in simulation.notes if "breaks" in n] == notes
        again, x = shape(simulation), simulation.problem.equations.x
        rows = springs(simulation).table_rows(x)
    if comm.rank == 0:
        table = {name: np.asarray(values) for name, values in StoredRun(folder).attachments.items()}
        n_steps = int(table["step"][-1])
        assert table["step"].tolist() == np.repeat(np.arange(n_steps + 1), 2).tolist()
        assert [table["holding"][0], table["holding"][-2]] == [3, rows[0][1]]
        np.testing.assert_allclose(table["tension"][-2:], [row[-1] for row in rows], rtol=1e-12)
        assert rows[0][1] < 3
        np.testing.assert_allclose(again, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_plate_falls_freely_after_its_spring_breaks(integrator: str) -> None:
    """In the steps after the break no force of the spring is left, in no history of an integrator."""
    scene = hanging(breaks_at=0.6 * WEIGHT) | {
        "handles": [{"group": "top"}, {"group": "bottom", "axes": ["x", "y"]}],
        "time": {"end": 0.3, "step": 0.005, "integrator": integrator},
    }
    with stepped(MPI.COMM_SELF, scene, **SOLVER) as simulation:
        while not springs(simulation).broken.any():
            simulation.step()
        equations, start = simulation.problem.equations, simulation.time
        assert 0.01 < start < 0.1
        before = equations.v[9:, 2]
        for _ in range(4):
            simulation.step()
        change = np.average(equations.v[9:, 2] - before, weights=equations.mass[9:])
        assert change == pytest.approx(-10.0 * (simulation.time - start), rel=1e-6)
