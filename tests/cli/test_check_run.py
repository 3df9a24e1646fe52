"""``check`` of a run's folder counts crossing triangles."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from launch import done, lyra, refused
from mpi4py import MPI

from lyra_petsc.cli.check_run import check_run
from lyra_petsc.errors import InputError
from lyra_petsc.mesh.mesh import Mesh, TriangleSurface
from lyra_petsc.output.file_operations import replace_text
from lyra_petsc.output.mesh_file import write_mesh
from lyra_petsc.output.ordering import FileOrder
from lyra_petsc.output.states import StateWriter
from lyra_petsc.scene.dump import dump_scene
from lyra_petsc.scene.schema import Scene

# two triangles with a common vertex, and one apart
REST = np.array([[0, 0, 0], [2, 1, 0], [2, -1, 0], [2, 0, 1], [2, 0, 2], [1, 0, 5], [1, 1, 5], [1, 0, 6.0]])
TRIANGLES = np.array([[0, 1, 2], [3, 0, 4], [5, 6, 7]])

DOWN = REST - [0, 0, 1.5] * (np.arange(8) == 3)[:, None]
"""The second triangle crosses the first, from their common vertex on."""

ALL = DOWN.copy()
ALL[5:] = [[1, 0, 9], [1.5, 0.25, -9], [1.5, -0.25, -9]]
"""The third triangle crosses both."""


BASE = {
    "mesh": {"grid": {"width": 1, "height": 1, "nx": 1, "ny": 1}},
    "material": {"density": 0.1, "membrane": {"c11": 1, "c22": 1, "c12": 0, "c33": 1}},
    "time": {"end": 1.0, "step": 0.1},
}
OBSTACLES = {
    "floor": {"plane": {"point": [0, 0, -0.25], "normal": [0, 0, 3]}},
    "ball": {
        "sphere": {"center": [1, 0, -19], "radius": 0.5},
        "motion": [{"time": 0.1 * k, "translate": [0, 0, z]} for k, z in ((1, 0), (2, 19), (3, 0))],
    },
    "wall": {"mesh": {"file": "wall.obj"}},
    "room": {"box": {"min": [-5, -5, -5], "max": [5, 5, 7]}, "inside": True},
    "bowl": {"sphere": {"center": [0, 0, 0], "radius": 8}, "inside": True},
    "crate": {"box": {"min": [1.9, -0.1, 0.9], "max": [2.1, 0.1, 1.1]}},
}
WALL = TriangleSurface(np.array([[0, 0.25, 5.25], [2, 0.25, 5.25], [1, 0.25, 9]]), np.array([[0, 1, 2]]))


def written(path: Path, **keys: object) -> Path:
    """A run with five states, of which two have crossings, and keys of its scene."""
    comm = MPI.COMM_SELF
    if MPI.COMM_WORLD.rank == 0:
        path.mkdir()
        mesh = Mesh(REST, REST, TRIANGLES, REST[TRIANGLES][..., :2], np.ones(3, dtype=bool), has_uv=False)
        mesh.obstacles.update({"wall": WALL} if "obstacles" in keys else {})
        write_mesh(path, mesh, comm)
        replace_text(path / "scene.yaml", dump_scene(Scene.model_validate({**BASE, **keys})))
        orders = [FileOrder(comm, np.arange(n), n) for n in (len(REST), len(TRIANGLES))]
        states = StateWriter(path, *orders, n_triangles=len(TRIANGLES))
        for i, x in enumerate((REST, DOWN, REST, ALL, REST)):
            states.write(i, 0.1 * i, x, {})()
    MPI.COMM_WORLD.Barrier()
    return path


@pytest.fixture
def folder(shared_tmp: Path) -> Path:
    """A run without contact."""
    return written(shared_tmp / "run")


TABLE = """\
run: 5 states; pairs of triangles that cross, with
state    time [s] no common vertex one common vertex  first
    0           0                0                 0
    1         0.1                0                 1  0-1
    2         0.2                0                 0
    3         0.3                2                 1  0-2, 1-2, 0-1
    4         0.4                0                 0
crossings in 2 of 5 states, most in state 3: 3 pairs
"""
NO_CONTACT = "the scene has no contact of sheets; --crossings makes a crossing exit code 1\n"


@pytest.mark.parallel(2)
@pytest.mark.quick
@pytest.mark.parametrize(
    ("contact", "asked", "code"),
    [
        (None, False, 0),
        (None, True, 1),
        ({}, False, 1),
        ({"self": False}, False, 0),
        ({"self": False}, True, 1),
    ],
)
def test_crossings_are_counted_on_any_number_of_ranks(
    comm: MPI.Comm,
    shared_tmp: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    contact: object,
    asked: int,
    code: int,
) -> None:
    written(shared_tmp / "run", **({} if contact is None else {"contact": contact}))
    monkeypatch.chdir(shared_tmp)
    assert check_run(comm, Path("run"), crossings=bool(asked)) == code
    said = capsys.readouterr().out
    assert said == (TABLE + ("" if code else NO_CONTACT) if comm.rank == 0 else "")


@pytest.mark.parallel(2)
@pytest.mark.parametrize("alone", [False, True])
def test_crossings_with_obstacles(
    comm: MPI.Comm, shared_tmp: Path, capsys: pytest.CaptureFixture[str], alone: bool
) -> None:
    """In the second state a vertex is below the floor; the ball crosses in the third state only."""
    run = written(shared_tmp / "run", contact={"self": not alone}, obstacles=OBSTACLES)
    assert check_run(comm, run) == 1
    said = [line.split(maxsplit=7) for line in capsys.readouterr().out.splitlines()]
    if comm.rank == 0:
        assert [" ".join(row[2:]) for row in said[2:7]] == [
            "0 0 1 2 2 wall: triangle 2, crate: vertex 3",
            "0 1 1 3 3 0-1, floor: vertex 3, wall: triangle 2, crate: triangle 1",
            "0 0 1 5 4 ball: triangle 0, wall: triangle 2, crate: vertex 3",
            "2 1 9 12 5 0-2, 1-2, 0-1, floor: vertex 3, room: vertex 5, bowl: vertex 5",
            "0 0 1 2 2 wall: triangle 2, crate: vertex 3",
        ]
        assert " ".join(said[8]).startswith(
            "parts of sheets in obstacles in 5 of 5 states, most in state 3: 26"
        )


@pytest.mark.parallel(2)
@pytest.mark.parametrize("alone", [False, True])
def test_triangles_beyond_a_symmetry_plane(
    comm: MPI.Comm, shared_tmp: Path, capsys: pytest.CaptureFixture[str], alone: bool
) -> None:
    """In two states vertex 3 is below the plane z = 0 of its sheet, in one of them two of another sheet are,
    too.
    """
    plane = [{"nodes": [0, 1, 2], "symmetry": "z"}]
    run = written(shared_tmp / "run", contact={"self": not alone}, handles=plane)
    assert check_run(comm, run) == int(not alone)
    said = [line.split(maxsplit=7) for line in capsys.readouterr().out.splitlines()]
    if comm.rank == 0 and not alone:
        assert [" ".join(row[2:]) for row in said[2:7]] == [
            "0 0 0 0 0",
            "0 1 1 2 1 0-1, symmetry plane z = 0: vertex 3",
            "0 0 0 0 0",
            "2 1 3 5 2 0-2, 1-2, 0-1, symmetry plane z = 0: vertex 3",
            "0 0 0 0 0",
        ]
        assert " ".join(said[8]).startswith(
            "parts of sheets in obstacles or behind symmetry planes in 2 of 5 states, most in state 3: 10"
        )
    elif comm.rank == 0:
        assert said[0][-1].endswith("with")
        assert not any("vertices in" in " ".join(row) for row in said)


@pytest.mark.parallel(2)
def test_a_damaged_state_is_reported_on_all_ranks(comm: MPI.Comm, folder: Path) -> None:
    if comm.rank == 0:
        (folder / "mesh.h5").write_bytes(b"none")
    comm.Barrier()
    with pytest.raises(InputError, match=r"mesh\.h5: cannot be read, or is damaged"):
        check_run(comm, folder)


def test_the_command(folder: Path) -> None:
    result = lyra(["check", "run"], folder.parent)
    assert (result.code, result.out) == (0, TABLE + NO_CONTACT)
    for ranks in (1, 2):
        judged = lyra(["check", "run", "--crossings"], folder.parent, ranks=ranks)
        assert (judged.code, judged.out) == (1, TABLE)
    for words, why in (
        (["run", "--set", "time.end=1"], "run: for the folder of a run there is no option but --crossings"),
        (["run", "--schema"], "run: for the folder of a run there is no option but --crossings"),
        (["--crossings"], "--crossings: needs the folder of a run"),
        (["other", "--crossings"], "other: no such folder; give the folder of a run"),
        (["."], ".: is not the folder of a run"),
    ):
        refused(["check", *words], folder.parent, why)


def test_a_real_run_has_no_crossings(tmp_path: Path) -> None:
    (tmp_path / "scene.json").write_text(json.dumps(BASE))
    assert lyra(["run", "scene.json", "--out", "run"], tmp_path).code == 0
    checked = done(["check", "run", "--crossings"], tmp_path)
    assert checked.out.endswith("no crossings in 26 states\n")
