"""The matrix has entries for the couplings of the active terms only."""

from __future__ import annotations

import json
import sys
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from patience import run_program
from physics import CLOTH, Simulation, grid

from lyra_petsc.linear.matrix import AssembledMatrix

NX, NY = 6, 5


def couplings(mesh: dict[str, Any], comm: MPI.Comm, **more: Any) -> set[tuple[int, int]]:
    """Coupled vertex pairs (mesh numbers) of a scene's matrix, including the diagonal, on every rank."""
    with Simulation({"mesh": mesh} | more, comm) as simulation:
        points, pattern = simulation.problem.points, simulation.problem.pattern
        mesh_number = np.empty(points.n_global, dtype=np.int64)
        for start, original in comm.allgather((points.start, points.mesh_vertices)):
            mesh_number[start : start + len(original)] = original
        local = mesh_number[points.global_number]
        rows, columns = np.repeat(np.arange(points.n_owned), np.diff(pattern.indptr)), pattern.columns
        pairs = list(zip(local[rows].tolist(), local[columns].tolist(), strict=True))
        upper = (rows < columns) & (columns < points.n_owned)
        pairs += zip(local[columns[upper]].tolist(), local[rows[upper]].tolist(), strict=True)
        assert len(pairs) == pattern.n_couplings
        every = [pair for part in comm.allgather(pairs) for pair in part]
        assert len(every) == len(set(every))
        matrix = AssembledMatrix(points, pattern, "baij")
        stored = matrix.mat.getInfo()["nz_allocated"]  # over all ranks
        matrix.destroy()
        assert stored / 9 == len(every)
        return set(every)


def stencil_pairs(stencils: list[tuple[int, ...]]) -> set[tuple[int, int]]:
    return {(a, b) for stencil in stencils for a in stencil for b in stencil}


def grid_stencils() -> tuple[list[tuple[int, ...]], list[tuple[int, ...]]]:
    """Triangles and hinges of the diagonal grid, found by brute force."""
    triangles = []
    for j in range(NY):
        for i in range(NX):
            a, b = j * (NX + 1) + i, (j + 1) * (NX + 1) + i
            triangles += [(a, a + 1, b + 1), (a, b + 1, b)]
    hinges = []
    for k, one in enumerate(triangles):
        hinges += [tuple({*one, *two}) for two in triangles[:k] if len({*one} & {*two}) == 2]
    return triangles, hinges


@pytest.mark.parallel
def test_membrane_scene_has_membrane_couplings_only(comm: MPI.Comm) -> None:
    triangles, _ = grid_stencils()
    more = {"gravity": [0, 0, -9.81], "handles": [{"nodes": [0]}], "loads": [{"pressure": 1.0}]}
    wind = {"wind": {"velocity": [0, 0, 1], "density": 1.0}}
    expected = stencil_pairs(triangles)
    assert couplings(grid(1, 1, NX, NY), comm) == expected
    assert couplings(grid(1, 1, NX, NY), comm, **more, **wind) == expected


@pytest.mark.parallel
def test_hinges_couple_opposite_vertices_too(comm: MPI.Comm) -> None:
    triangles, hinges = grid_stencils()
    bent = couplings(grid(1, 1, NX, NY), comm, material=CLOTH | {"bending": 1e-4})
    assert bent == stencil_pairs(triangles) | stencil_pairs(hinges)
    assert len(bent) > 1.5 * len(stencil_pairs(triangles))


SCRIPT = """
import json, sys
import petsc4py
petsc4py.init(["test", "-pc_type", "lu"])
from mpi4py import MPI
from lyra_petsc.scene.schema import Scene
from lyra_petsc.phases import Phases
from lyra_petsc.stepping.problem import build_problem
from lyra_petsc.stepping.stepper import Stepper

scene = Scene.model_validate(json.loads(sys.argv[1]))
problem = build_problem(MPI.COMM_SELF, scene, Phases())
stepper = Stepper(scene, problem.equations, problem.surface, problem.whole.spacing, 1e-12)
stepper.start(0.0, 0)
assert stepper.attempt(0.0, 0.01).converged
print(json.dumps(sorted(m for m in sys.modules if m.startswith("lyra_petsc.") or m in HEAVY)))
"""
HEAVY = ("gmsh", "h5py", "ruamel.yaml", "rich")


def imported(**more: Any) -> set[str]:
    """Modules that are loaded after one step of a scene, in a new interpreter."""
    scene = {
        "mesh": grid(1, 1, 2, 2),
        "material": CLOTH,
        "time": {"end": 1, "step": 0.01},
        "initial": {"velocity": [0, 0, 1]},
    } | more
    script = SCRIPT.replace("HEAVY", repr(HEAVY))
    done = run_program(
        [sys.executable, "-c", script, json.dumps(scene)],
        seconds=120,
    )
    assert done.returncode == 0, done.stderr
    return set(json.loads(done.stdout.splitlines()[-1]))


@pytest.fixture(scope="module")
def of_membrane() -> set[str]:
    return imported()


MEMBRANE_SCENE = {
    "energies",
    "handles",
    "handles.motion",
    "handles.prescribed_handles",
    "membrane",
    "membrane_laws",
    "membrane_laws.stvk",
    "protocols",
    "registry",
    "rest",
    "step_end",
    "term",
    "units_check",
}
"""Modules of ``terms`` that every scene needs."""


@pytest.mark.slow
def test_a_membrane_scene_imports_and_compiles_no_other_term(of_membrane: set[str]) -> None:
    terms = {m.removeprefix("lyra_petsc.terms.") for m in of_membrane if m.startswith("lyra_petsc.terms.")}
    assert terms == MEMBRANE_SCENE
    assert not {m for m in of_membrane if m.startswith("lyra_petsc.contact")}
    assert not of_membrane & set(HEAVY)


@pytest.mark.slow
def test_each_key_of_a_scene_imports_its_own_term_only(of_membrane: set[str]) -> None:
    without = {m for m in of_membrane if ".terms." in m}
    added = {
        "wind": {"wind": {"velocity": [0, 0, 1], "density": 1.0}},
        "gravity": {"gravity": [0, 0, -9.81]},
        "pressure": {"loads": [{"pressure": 1.0}]},
    }
    loads = "lyra_petsc.terms.loads"
    for term, keys in added.items():
        assert {m for m in imported(**keys) if ".terms." in m} - without == {loads, f"{loads}.{term}"}
