"""states.vtkhdf as read by VTK: times, positions and fields are those that were written."""

import numpy as np
import pytest
from mpi4py import MPI
from vtkhdf_reader import read
from written_run import REST, TRIANGLES, position, ring, tensor, velocity

from lyra_petsc.errors import OutputError
from lyra_petsc.output import states as states_module
from lyra_petsc.output.layout import CELLS_FILE, VTKHDF_FILE
from lyra_petsc.output.mesh_file import write_mesh
from lyra_petsc.output.ordering import FileOrder
from lyra_petsc.output.read_run import stored_states
from lyra_petsc.output.states import StateWriter
from lyra_petsc.parallel import on_root

pytestmark = pytest.mark.parallel(3)


class Writer:
    """A writer for the ring, whose vertices and triangles are distributed to the ranks."""

    def __init__(self, comm, folder, resume_after=None, vtkhdf=True):
        self.vertices = np.arange(len(REST))[::-1][comm.rank :: comm.size]
        self.triangles = np.arange(len(TRIANGLES))[comm.rank :: comm.size]
        orders = (FileOrder(comm, rows, 8) for rows in (self.vertices, self.triangles))
        self.states = StateWriter(
            folder, *orders, n_triangles=len(TRIANGLES), resume_after=resume_after, vtkhdf=vtkhdf
        )

    def write(self, i, fields=True):
        announce = self.states.write(
            i,
            0.1 * i,
            position(i)[self.vertices],
            {
                "velocity": ("vertex", velocity(i)[self.vertices]),
                "rank": ("vertex", 0 * self.vertices + i),
                "stress": ("triangle", tensor(i)[self.triangles]),
            }
            if fields
            else {},
        )
        on_root(self.states.vertices.comm, announce)


@pytest.fixture
def folder(shared_tmp, comm):
    write_mesh(shared_tmp, ring() if comm.rank == 0 else None, comm)
    return shared_tmp


def check(path, numbers):
    found = read(path)
    np.testing.assert_array_equal([time for time, *_ in found], [0.1 * i for i in numbers])
    for i, (_, points, triangles, arrays) in zip(numbers, found, strict=True):
        np.testing.assert_array_equal(points, position(i))
        np.testing.assert_array_equal(triangles, TRIANGLES)
        assert set(arrays["vertex"]) == {"rest", "velocity", "rank"}
        assert set(arrays["triangle"]) == {"stress"}
        np.testing.assert_array_equal(arrays["vertex"]["rest"], REST)
        np.testing.assert_array_equal(arrays["vertex"]["velocity"], velocity(i))
        np.testing.assert_array_equal(arrays["vertex"]["rank"], i)
        np.testing.assert_array_equal(arrays["triangle"]["stress"], tensor(i)[:, [0, 3, 5, 1, 4, 2]])


def on_rank_0(comm, work):
    """Call a function that only reads on rank 0; a failure is raised on all ranks."""
    comm.barrier()
    if comm.rank == 0:
        work()
    comm.barrier()


def test_all_times_and_fields_are_readable_after_every_state(folder, comm):
    writer = Writer(comm, folder)
    for i in range(4):
        writer.write(i)
        on_rank_0(comm, lambda i=i: check(folder / VTKHDF_FILE, range(i + 1)))


def test_resuming_leaves_no_gap_and_no_duplicate(folder, comm):
    writer = Writer(comm, folder)
    for i in range(5):
        writer.write(i)
    again = Writer(comm, folder, resume_after=2)
    on_rank_0(comm, lambda: check(folder / VTKHDF_FILE, [0, 1, 2]))
    again.write(3)
    on_rank_0(comm, lambda: check(folder / VTKHDF_FILE, [0, 1, 2, 3]))


def test_resuming_with_and_without_vtkhdf(folder, comm):
    Writer(comm, folder, vtkhdf=False).write(0)
    assert not (folder / VTKHDF_FILE).exists()
    assert not (folder / CELLS_FILE).exists()
    Writer(comm, folder, resume_after=0).write(1)
    on_rank_0(comm, lambda: check(folder / VTKHDF_FILE, [0, 1]))
    Writer(comm, folder, resume_after=1, vtkhdf=False)
    assert not (folder / VTKHDF_FILE).exists()


def test_a_field_missing_in_some_states(folder, comm):
    Writer(comm, folder).write(0, fields=False)
    Writer(comm, folder, resume_after=0).write(1)

    def compare():
        (_, points, _, arrays), later = read(folder / VTKHDF_FILE)
        np.testing.assert_array_equal(points, position(0))
        assert np.isnan(arrays["vertex"]["velocity"]).all()
        np.testing.assert_array_equal(later[3]["vertex"]["velocity"], velocity(1))

    on_rank_0(comm, compare)


def test_a_full_disk_leaves_the_earlier_states(folder, comm, monkeypatch):
    writer = Writer(comm, folder)
    writer.write(0)
    writer.write(1)

    def fails(*arguments):
        raise OutputError("states.vtkhdf: cannot be written: No space left on device")

    with monkeypatch.context() as broken:
        broken.setattr(states_module, "write_vtkhdf", fails)
        with pytest.raises(OutputError, match="No space left"):
            writer.write(2)
    on_rank_0(comm, lambda: check(folder / VTKHDF_FILE, [0, 1]))
    again = Writer(comm, folder, resume_after=1)
    assert again.states._next == 2
    assert len(stored_states(folder)) == 2


def test_the_folder_may_be_moved(folder, comm, tmp_path_factory):
    Writer(comm, folder).write(0)

    def move():
        moved = folder.rename(folder.with_name(folder.name + "-moved"))
        check(moved / VTKHDF_FILE, [0])

    on_rank_0(comm, move)


def test_a_thousand_states_are_listed_quickly(folder, comm):
    if comm.size > 1:
        pytest.skip("one rank is enough")
    writer = Writer(comm, folder)
    for i in range(3):
        writer.write(i)
    began = MPI.Wtime()
    states_module.write_vtkhdf(folder, stored_states(folder) * 333, 8, 8)
    assert MPI.Wtime() - began < 2.0
