"""Stress and strain as symmetric tensors of six components, in each reader's order."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from written_run import TRIANGLES, stress, tensor, written

from lyra_petsc.output.layout import XDMF_FILE
from lyra_petsc.output.read_run import StoredRun
from lyra_petsc.output.tensors import plane_components, six_components
from lyra_petsc.show.export import export_run

NUMBERED = np.arange(6.0)[None]


def test_orders_of_components() -> None:
    np.testing.assert_array_equal(six_components(np.array([[1.0, 2.0, 3.0]])), [[1, 3, 0, 2, 0, 0]])
    np.testing.assert_array_equal(plane_components(NUMBERED), [[0, 3, 1]])


def test_vtk_reads_tensors_from_xdmf(tmp_path: Path) -> None:
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import vtk_to_numpy

    path = written(tmp_path / "run") / XDMF_FILE
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
    run = written(tmp_path / "run")
    np.testing.assert_array_equal(StoredRun(run).field("stress"), [tensor(i) for i in range(3)])
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
