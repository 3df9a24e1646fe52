"""``check`` of a run's folder counts the triangles that cross."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from launch import lyra
from mpi4py import MPI
from written_run import scene

from lyra_petsc.cli.check_run import check_run
from lyra_petsc.errors import InputError
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.output.atomic import replace_text
from lyra_petsc.output.mesh_file import write_mesh
from lyra_petsc.output.ordering import FileOrder
from lyra_petsc.output.states import StateWriter
from lyra_petsc.scene.dump import dump_scene
from lyra_petsc.scene.schema import Scene

# two triangles with a common vertex, and one apart
REST = np.array([[0, 0, 0], [2, 1, 0], [2, -1, 0], [2, 0, 1], [2, 0, 2], [1, 0, 5], [1, 1, 5], [1, 0, 6.0]])
TRIANGLES = np.array([[0, 1, 2], [3, 0, 4], [5, 6, 7]])

DOWN = REST - [0, 0, 1.5] * (np.arange(8) == 3)[:, None]
"""The second goes through the first, from their common vertex on."""

ALL = DOWN.copy()
ALL[5:] = [[1, 0, 9], [1.5, 0.25, -9], [1.5, -0.25, -9]]
"""And the third through both."""


@pytest.fixture
def folder(shared_tmp: Path) -> Path:
    """A run with five states, of which two have crossings."""
    comm, path = MPI.COMM_SELF, shared_tmp / "run"
    if MPI.COMM_WORLD.rank == 0:
        path.mkdir()
        uv = REST[TRIANGLES][..., :2]
        write_mesh(path, Mesh(REST, REST, TRIANGLES, uv, np.ones(3, dtype=bool), has_uv=False), comm)
        replace_text(path / "scene.yaml", dump_scene(scene()))
        orders = [FileOrder(comm, np.arange(n), n) for n in (len(REST), len(TRIANGLES))]
        states = StateWriter(path, *orders, n_triangles=len(TRIANGLES))
        for i, x in enumerate((REST, DOWN, REST, ALL, REST)):
            states.write(i, 0.1 * i, x, {}, {})
    MPI.COMM_WORLD.Barrier()
    return path


TABLE = """\
run: 5 states; pairs of triangles that cross, with
state    time [s] no common vertex one common vertex  first pairs
    0           0                0                 0
    1         0.1                0                 1  0-1
    2         0.2                0                 0
    3         0.3                2                 1  0-2, 1-2, 0-1
    4         0.4                0                 0
crossings in 2 of 5 states, most in state 3: 3 pairs
"""
NO_CONTACT = "the scene has no contact"
REMEDY = "; --crossings makes a crossing exit code 1"


@pytest.mark.parallel
@pytest.mark.quick
@pytest.mark.parametrize(("contact", "asked", "code"), [(0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 1)])
def test_crossings_are_counted_on_any_number_of_ranks(
    comm: MPI.Comm,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    contact: int,
    asked: int,
    code: int,
) -> None:
    if contact:
        monkeypatch.setattr(Scene, "contact", {}, raising=False)
    monkeypatch.chdir(folder.parent)
    assert check_run(comm, Path("run"), crossings=bool(asked)) == code
    said = capsys.readouterr().out
    end = "" if contact else NO_CONTACT + ("" if asked else REMEDY) + "\n"
    assert said == (TABLE + end if comm.rank == 0 else "")


@pytest.mark.parallel
def test_a_damaged_state_is_told_by_all_ranks(comm: MPI.Comm, folder: Path) -> None:
    if comm.rank == 0:
        (folder / "mesh.h5").write_bytes(b"none")
    comm.Barrier()
    with pytest.raises(InputError, match=r"mesh\.h5: cannot be read, or is damaged"):
        check_run(comm, folder)


def test_the_verb(folder: Path) -> None:
    told = lyra(["check", "run"], folder.parent)
    assert (told.code, told.out) == (0, TABLE + NO_CONTACT + REMEDY + "\n")
    for ranks in (1, 2):
        judged = lyra(["check", "run", "--crossings"], folder.parent, ranks=ranks)
        assert (judged.code, judged.out) == (1, TABLE + NO_CONTACT + "\n")
    for words, why in (
        (["run", "--set", "time.end=1"], "run: for the folder of a run there is no option but --crossings"),
        (["run", "--schema"], "run: for the folder of a run there is no option but --crossings"),
        (["--crossings"], "--crossings: needs the folder of a run"),
        (["other", "--crossings"], "other: no such folder; give the folder of a run"),
        (["."], ".: is not the folder of a run"),
    ):
        refused = lyra(["check", *words], folder.parent)
        assert refused.code == 2
        assert len(refused.err.splitlines()) == 1
        assert why in refused.err


def test_a_run_of_the_program_without_crossings(tmp_path: Path) -> None:
    square = scene().model_dump_json()  # which falls nowhere
    (tmp_path / "scene.json").write_text(square)
    assert lyra(["run", "scene.json", "--out", "run"], tmp_path).code == 0
    checked = lyra(["check", "run", "--crossings"], tmp_path)
    assert checked.code == 0, checked.err
    assert "no crossings in" in checked.out
