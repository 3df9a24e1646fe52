"""VTK's reader of VTKHDF files; tests that import this are skipped without VTK."""

import numpy as np
import pytest

vtk_hdf = pytest.importorskip("vtkmodules.vtkIOHDF")

from vtkmodules.util.numpy_support import vtk_to_numpy  # noqa: E402
from vtkmodules.vtkCommonExecutionModel import (  # noqa: E402
    vtkStreamingDemandDrivenPipeline as Pipeline,
)


def read(path):
    """Time and grid of every step, by VTK."""
    reader = vtk_hdf.vtkHDFReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    times = list(reader.GetOutputInformation(0).Get(Pipeline.TIME_STEPS()) or [])
    found = []
    for time in times or [0.0]:  # VTK tells no time of a single step
        reader.UpdateTimeStep(time)
        grid = reader.GetOutputDataObject(0)
        arrays = {"vertex": arrays_of(grid.GetPointData()), "triangle": arrays_of(grid.GetCellData())}
        triangles = np.array(vtk_to_numpy(grid.GetCells().GetConnectivityArray())).reshape(-1, 3)
        assert {grid.GetCellType(i) for i in range(grid.GetNumberOfCells())} == {5}
        found.append((time, np.array(vtk_to_numpy(grid.GetPoints().GetData())), triangles, arrays))
    return found


def arrays_of(data):
    numbers = range(data.GetNumberOfArrays())
    return {data.GetArrayName(i): np.array(vtk_to_numpy(data.GetArray(i))) for i in numbers}
