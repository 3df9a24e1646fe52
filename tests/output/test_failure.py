"""failure.xdmf, failure.h5 and failure.txt, read as by ParaView."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from test_states import announced, on_first

from lyra_petsc.errors import OutputError
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.output.layout import FAILURE_DATA, FAILURE_TEXT, FAILURE_XDMF, RESULT
from lyra_petsc.output.mesh_file import write_mesh
from lyra_petsc.output.ordering import FileOrder
from lyra_petsc.output.states import FailureState, remove_failure, write_failure

pytestmark = pytest.mark.parallel(3)

REST = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [2, 0, 0]], dtype=float)
TRIANGLES = np.array([[0, 1, 2], [1, 3, 2], [1, 4, 3]])


def write(comm: MPI.Comm, folder: Path) -> None:
    mesh = Mesh(REST, REST, TRIANGLES, REST[TRIANGLES][..., :2].copy(), np.zeros(3, dtype=bool))
    write_mesh(folder, mesh if comm.rank == 0 else None, comm)
    owned = np.arange(5)[::-1][comm.rank :: comm.size]
    before = FailureState(0.25, REST[owned], {"velocity": REST[owned]})
    failing = FailureState(0.375, REST[owned] + 1, {"velocity": 1 + REST[owned], "residual": 2 * REST[owned]})
    write_failure(folder, FileOrder(comm, owned, 5), 3, 7, (before, failing), "why\n")


def test_both_states_can_be_read_with_their_times(comm: MPI.Comm, shared_tmp: Path) -> None:
    write(comm, shared_tmp)

    def check() -> None:
        before, failing = announced(shared_tmp, FAILURE_XDMF)
        for number, (time, seen) in enumerate((before, failing)):
            assert time == 0.25 + 0.125 * number
            assert np.array_equal(seen.points, REST + number)
            assert np.array_equal(seen.cells_dict["triangle"], TRIANGLES)
            assert np.array_equal(seen.point_data["velocity"], number + REST)
        assert "residual" not in before[1].point_data
        assert np.array_equal(failing[1].point_data["residual"], 2 * REST)
        assert (shared_tmp / FAILURE_TEXT).read_text() == "why\n"
        assert not list(shared_tmp.glob("*.part"))

    on_first(comm, check)


def test_a_new_run_removes_files_of_a_failure(comm: MPI.Comm, shared_tmp: Path) -> None:
    write(comm, shared_tmp)
    assert all(RESULT.fullmatch(name) for name in (FAILURE_XDMF, FAILURE_DATA, FAILURE_TEXT))

    def check() -> None:
        assert len(list(shared_tmp.glob("failure*"))) == 3
        remove_failure(shared_tmp)
        remove_failure(shared_tmp)  # nothing there is no mistake
        assert not list(shared_tmp.glob("failure*"))

    on_first(comm, check)


def test_a_missing_folder_is_reported_on_all_ranks(comm: MPI.Comm, shared_tmp: Path) -> None:
    owned = np.arange(5)[comm.rank :: comm.size]
    moment = FailureState(0.0, REST[owned], {})
    with pytest.raises(OutputError, match=r"failure\.txt: cannot be written"):
        write_failure(shared_tmp / "gone", FileOrder(comm, owned, 5), 3, 0, (moment, moment), "")
