"""Stress and strain as symmetric tensors of six components, in each reader's order; older folders."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, grid, scene_of
from written_run import TRIANGLES, stress, tensor, written

from lyra_petsc.api.run_loop import ProgressCallbacks, simulate
from lyra_petsc.errors import InputError
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.output.run_folder import FolderChoice
from lyra_petsc.output.tensors import in_vtk_order, plane_components, six_components
from lyra_petsc.output.xdmf import XDMF_FILE
from lyra_petsc.show.export import export_run
from lyra_petsc.show.render.colour_quantities import quantity

NUMBERED = np.arange(6.0)[None]


def test_orders_of_components() -> None:
    np.testing.assert_array_equal(in_vtk_order(NUMBERED), [[0, 3, 5, 1, 4, 2]])
    np.testing.assert_array_equal(six_components(np.array([[1.0, 2.0, 3.0]])), [[1, 3, 0, 2, 0, 0]])
    np.testing.assert_array_equal(plane_components(NUMBERED), [[0, 3, 1]])
    np.testing.assert_array_equal(plane_components(stress(1)), stress(1))


def test_readers_accept_three_and_six_components(tmp_path: Path) -> None:
    older, now = StoredRun(written(tmp_path / "older")), StoredRun(written(tmp_path / "now", six=True))
    np.testing.assert_array_equal(older.field("stress"), [stress(i) for i in range(3)])
    np.testing.assert_array_equal(now.field("stress"), [tensor(i) for i in range(3)])
    np.testing.assert_array_equal(quantity(now, "stress").values(2), quantity(older, "stress").values(2))


def test_another_number_of_components_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "run", six=True) / XDMF_FILE
    path.write_text(path.read_text().replace('Dimensions="8 6"', 'Dimensions="8 5"'))
    with pytest.raises(InputError, match="damaged"):
        StoredRun(tmp_path / "run")


def test_vtk_reads_tensors_from_xdmf(tmp_path: Path) -> None:
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import vtk_to_numpy

    path = written(tmp_path / "run", six=True) / XDMF_FILE
    assert path.read_text().count('Name="stress" AttributeType="Tensor6"') == 3
    reader = vtk.vtkXdmfReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    reader.UpdateTimeStep(0.2)
    found = vtk_to_numpy(reader.GetOutputDataObject(0).GetCellData().GetArray("stress")).reshape(-1, 3, 3)
    np.testing.assert_array_equal(found[:, [0, 1, 0, 1], [0, 1, 1, 0]], stress(2)[:, [0, 1, 2, 2]])
    assert not found[:, 2].any()
    assert not found[:, :, 2].any()


def test_exported_tensors(tmp_path: Path) -> None:
    run = written(tmp_path / "run", six=True)
    found = np.load(export_run(run, "npz").folder / "run.npz")
    np.testing.assert_array_equal(found["stress"], [tensor(i) for i in range(3)])
    data = pytest.importorskip("xarray") and StoredRun(run).dataset()
    np.testing.assert_array_equal(data["stress"].sel(component="vv")[2], stress(2)[:, 1])
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(export_run(run, "usd").folder / "run.usdc"))
    primvar = UsdGeom.PrimvarsAPI(stage.GetDefaultPrim().GetChild("cloth")).GetPrimvar("stress")
    assert (primvar.GetElementSize(), primvar.GetInterpolation()) == (6, "uniform")
    rows = np.array(primvar.Get(2.0)).reshape(len(TRIANGLES), 6)
    np.testing.assert_array_equal(rows, tensor(2).astype(np.float32))


SCENE = {
    "mesh": grid(0.6, 0.4, 4, 3),
    "material": CLOTH,
    "gravity": [0, 0, -9.81],
    "handles": [{"nodes": [0, 4]}],
    "output": {"every": 0.01, "fields": ["green_strain", "stress"], "vtkhdf": True},
}


def run(comm: MPI.Comm, folder: Path, end: float, *, resume: bool = False) -> None:
    scene = scene_of(SCENE | {"time": {"end": end, "step": 0.005}})
    simulate(comm, scene, FolderChoice(folder, resume=resume), ProgressCallbacks(), lambda: 0)


@pytest.mark.parallel(2)
def test_an_older_folder_is_resumed_with_three_components(
    comm: MPI.Comm, shared_tmp: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(comm, shared_tmp / "now", 0.04)
    with monkeypatch.context() as older:
        older.setattr("lyra_petsc.output.fields.six_components", lambda plane: plane)
        run(comm, shared_tmp / "older", 0.02)
    run(comm, shared_tmp / "older", 0.04, resume=True)
    comm.Barrier()
    if comm.rank == 0:
        now, older = StoredRun(shared_tmp / "now"), StoredRun(shared_tmp / "older")
        assert len(now) == len(older) == 5
        for name in now.fields:
            expected = np.asarray([plane_components(rows) for rows in now.field(name)])
            found = np.asarray(older.field(name))
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    comm.Barrier()
