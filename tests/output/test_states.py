"""The time series of states: files, announcement, resumption."""

import os
import xml.etree.ElementTree as ElementTree

import meshio
import numpy as np
import pytest

from lyra_petsc.errors import InputError, OutputError
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.output import xdmf
from lyra_petsc.output.layout import XDMF_FILE
from lyra_petsc.output.mesh_file import write_mesh
from lyra_petsc.output.ordering import FileOrder
from lyra_petsc.output.read_run import stored_states
from lyra_petsc.output.states import StateWriter
from lyra_petsc.output.stored import import_h5py
from lyra_petsc.parallel import on_root

pytestmark = [pytest.mark.parallel, pytest.mark.quick]

h5py = import_h5py()

REST = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [2, 0, 0]], dtype=float)
TRIANGLES = np.array([[0, 1, 2], [1, 3, 2], [1, 4, 3]])


def strip() -> Mesh:
    return Mesh(REST + 1.0, REST, TRIANGLES, REST[TRIANGLES][..., :2], np.ones(3, dtype=bool))


class Run:
    """A writer for the strip, whose vertices and triangles are distributed to the ranks."""

    def __init__(self, comm, folder, resume_after=None):
        self.vertices = np.arange(5)[::-1][comm.rank :: comm.size]
        self.triangles = np.arange(3)[comm.rank :: comm.size]
        self.writer = StateWriter(
            folder,
            FileOrder(comm, self.vertices, 5),
            FileOrder(comm, self.triangles, 3),
            n_triangles=3,
            resume_after=resume_after,
        )

    def write(self, step):
        announce = self.writer.write(
            step,
            0.1 * step,
            position(step)[self.vertices],
            {
                "velocity": ("vertex", -position(step)[self.vertices]),
                "mass": ("vertex", np.arange(5.0)[self.vertices]),
                "rank": ("triangle", np.arange(3, dtype=np.int32)[self.triangles]),
                "green_strain": ("triangle", strain(step)[self.triangles]),
            },
        )
        on_root(self.writer.vertices.comm, announce)


@pytest.fixture
def run(comm, shared_tmp):
    """A run that has written its mesh."""
    write_mesh(shared_tmp, strip() if comm.rank == 0 else None, comm)
    return Run(comm, shared_tmp)


def position(step):
    return REST + [0, 0, step]


def strain(step):
    return step + np.arange(9.0).reshape(3, 3)


def announced(folder, series=XDMF_FILE):
    """Every state of the XDMF file as read by meshio: time and mesh."""
    document = ElementTree.parse(folder / series)
    states = []
    for grid in document.iterfind("Domain/Grid/Grid"):
        stamp = grid.find("Time")
        time = float(stamp.get("Value"))
        grid.remove(stamp)  # which meshio knows in its own kind of series only
        one = ElementTree.Element("Xdmf", Version="3.0")
        ElementTree.SubElement(one, "Domain").append(grid)
        name = folder / "one state.xdmf"
        ElementTree.ElementTree(one).write(name)
        states.append((time, meshio.read(name)))
        name.unlink()
    return states


def on_first(comm, check):
    """Read files on rank 0 while the other ranks wait."""
    comm.Barrier()
    try:
        if comm.rank == 0:
            check()
    finally:
        comm.Barrier()


def test_states_read_back_as_a_time_series(comm, shared_tmp, run):
    for step in (0, 4, 9):
        run.write(step)

    def check():
        states = announced(shared_tmp)
        assert [time for time, _ in states] == [0.0, 0.4, 0.9]
        for step, (_, mesh) in zip((0, 4, 9), states, strict=True):
            np.testing.assert_array_equal(mesh.points, position(step))
            np.testing.assert_array_equal(mesh.cells_dict["triangle"], TRIANGLES)
            np.testing.assert_array_equal(mesh.point_data["velocity"], -position(step))
            np.testing.assert_array_equal(mesh.point_data["mass"], np.arange(5.0))
            np.testing.assert_array_equal(mesh.point_data["rest"], REST)
            np.testing.assert_array_equal(mesh.cell_data["rank"][0], np.arange(3))
            np.testing.assert_array_equal(mesh.cell_data["green_strain"][0], strain(step))
        with h5py.File(shared_tmp / "states-0000.h5", "r") as file:
            assert file["written/step"][()].tolist() == [0, 4, 9, -1]
            assert file["written/time"][:3].tolist() == [0.0, 0.4, 0.9]
            assert file["states/000001/position"].dtype == np.float64

    on_first(comm, check)


def test_vtk_reads_the_time_series(comm, shared_tmp, run):
    vtk = pytest.importorskip("vtk", reason="ParaView's own reader; meshio's is tested above")
    for step in (0, 4, 9):
        run.write(step)

    def check():
        from vtk.util.numpy_support import vtk_to_numpy

        reader = vtk.vtkXdmfReader()
        reader.SetFileName(str(shared_tmp / XDMF_FILE))
        reader.UpdateInformation()
        assert reader.GetOutputInformation(0).Get(vtk.vtkStreamingDemandDrivenPipeline.TIME_STEPS()) == (
            0,
            0.4,
            0.9,
        )
        for step in (9, 0, 4):
            reader.UpdateTimeStep(0.1 * step)
            grid = reader.GetOutputDataObject(0)
            assert (grid.GetNumberOfPoints(), grid.GetNumberOfCells()) == (5, 3)
            np.testing.assert_array_equal(vtk_to_numpy(grid.GetPoints().GetData()), position(step))
            np.testing.assert_array_equal(
                vtk_to_numpy(grid.GetPointData().GetArray("velocity")), -position(step)
            )
            np.testing.assert_array_equal(
                vtk_to_numpy(grid.GetCellData().GetArray("green_strain")), strain(step)
            )

    on_first(comm, check)


def test_an_incomplete_state_is_never_listed(comm, shared_tmp, run, monkeypatch):
    run.write(0)

    def disk_full(*arguments):
        raise OSError(28, "disk full")

    with monkeypatch.context() as broken:
        broken.setattr("lyra_petsc.output.hdf5.put_rows", disk_full)
        with pytest.raises(OutputError, match=r"states-0000\.h5: cannot be written: No space left"):
            run.write(1)
    on_first(comm, lambda: assert_times(shared_tmp, [0.0]))
    run.write(2)
    on_first(comm, lambda: assert_times(shared_tmp, [0.0, 0.2]))


def assert_times(folder, times):
    assert [time for time, _ in announced(folder)] == pytest.approx(times)


def test_resume_keeps_earlier_states_and_continues(comm, shared_tmp, run):
    for step in (0, 3, 6, 9):
        run.write(step)
    comm.Barrier()
    if comm.rank == 0:
        (shared_tmp / XDMF_FILE).write_text("<Xdmf")
    comm.Barrier()
    resumed = Run(comm, shared_tmp, resume_after=5)
    assert resumed.writer._next == 2
    on_first(comm, lambda: assert_times(shared_tmp, [0.0, 0.3]))
    assert [state.number for state in stored_states(shared_tmp)] == [0, 1]
    comm.Barrier()
    resumed.write(7)
    on_first(comm, lambda: assert_times(shared_tmp, [0.0, 0.3, 0.7]))
    on_first(comm, lambda: np.testing.assert_array_equal(announced(shared_tmp)[1][1].points, position(3)))


def test_resume_skips_a_damaged_file(comm, shared_tmp, run):
    for step in range(11):
        run.write(step)
    assert sorted(path.name for path in shared_tmp.glob("states-*.h5")) == [
        "states-0000.h5",
        "states-0004.h5",
        "states-0008.h5",
    ]
    comm.Barrier()
    if comm.rank == 0:
        (shared_tmp / "states-0004.h5").write_bytes(b"")
    comm.Barrier()
    with pytest.raises(InputError, match=r"states-0004\.h5: cannot be read, or is damaged"):
        stored_states(shared_tmp)
    comm.Barrier()
    assert Run(comm, shared_tmp, resume_after=9).writer._next == 10
    assert [state.number for state in stored_states(shared_tmp)] == [0, 1, 2, 3, 8, 9]
    on_first(comm, lambda: assert_times(shared_tmp, [0.0, 0.1, 0.2, 0.3, 0.8, 0.9]))


def test_the_number_of_files_stays_small_and_the_xdmf_file_grows_in_place(comm, shared_tmp, run, monkeypatch):
    """Sizes of files double; the XDMF file is seldom copied, and complete after every write."""
    copies, whole = [], []
    make, pwrite = xdmf.GrowingXdmf._write_document, os.pwrite

    def counted(self, *arguments, **keywords):
        copies.append(1)
        return make(self, *arguments, **keywords)

    def checked(descriptor, content, offset):
        done = pwrite(descriptor, content, offset)
        if (shared_tmp / XDMF_FILE).exists():
            whole.append(len(ElementTree.parse(shared_tmp / XDMF_FILE).findall("./Domain/Grid/Grid")))
        return done

    monkeypatch.setattr(xdmf.GrowingXdmf, "_write_document", counted)
    monkeypatch.setattr(xdmf.os, "pwrite", checked)
    for step in range(90):
        run.write(step)
    assert len(list(shared_tmp.glob("states-*.h5"))) == 6
    if comm.rank == 0:
        assert len(copies) <= 9
        assert whole == sorted(whole)
        assert set(whole) == set(range(1, 91))
    on_first(comm, lambda: assert_times(shared_tmp, 0.1 * np.arange(90)))
    assert [state.step for state in stored_states(shared_tmp)] == list(range(90))


def test_a_removed_xdmf_file_is_written_again(comm, shared_tmp, run):
    for step in range(3):
        run.write(step)
    on_first(comm, (shared_tmp / XDMF_FILE).unlink)
    run.write(3)
    on_first(comm, lambda: assert_times(shared_tmp, [0.0, 0.1, 0.2, 0.3]))


def test_more_than_9999_states(comm, shared_tmp, run):
    run.write(0)
    run.writer._next = 9999
    run.write(1)
    run.write(2)
    resumed = Run(comm, shared_tmp, resume_after=2)
    assert resumed.writer._next == 10001
    resumed.write(3)
    on_first(comm, lambda: assert_times(shared_tmp, [0.0, 0.1, 0.2, 0.3]))
