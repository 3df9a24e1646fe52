"""The cloth as VTK objects, which trame sends to the page; the browser draws them."""

from __future__ import annotations

from typing import Any

import numpy as np
import vtkmodules.vtkRenderingOpenGL2  # noqa: F401  (registers the windows)
from numpy.typing import NDArray
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
from vtkmodules.vtkCommonCore import vtkLogger, vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
from vtkmodules.vtkRenderingCore import vtkActor, vtkPolyDataMapper, vtkRenderer, vtkRenderWindow

from lyra_petsc.show.render.camera import PerspectiveCamera
from lyra_petsc.show.render.sheet_geometry import vertex_normals
from lyra_petsc.show.view.page_content import Colours

Array = NDArray[np.float64]

BACKGROUND = (0.955, 0.96, 0.97)
PLAIN = (0.77, 0.34, 0.28)
EDGES = (0.15, 0.15, 0.18)


class Cloth:
    """The triangles with their camera; positions and colours change from state to state.

    Parameters
    ----------
    triangles : (F, 3) int64

    Attributes
    ----------
    window : vtkRenderWindow
    """

    def __init__(self, triangles: NDArray[np.int64]) -> None:
        vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)  # it would complain of a missing display
        self._data = vtkPolyData()
        self.set_mesh(triangles)
        self._mapper = vtkPolyDataMapper()
        self._mapper.SetInputData(self._data)
        self._mapper.SetColorModeToDirectScalars()
        actor = vtkActor()
        actor.SetMapper(self._mapper)
        self._look = actor.GetProperty()
        self._look.SetColor(*PLAIN)
        self._look.SetEdgeColor(*EDGES)
        self._look.SetAmbient(0.4)
        self._look.SetDiffuse(0.65)
        self._look.SetSpecular(0.08)
        self._look.SetSpecularPower(20.0)
        self._renderer = vtkRenderer()
        self._renderer.SetBackground(*BACKGROUND)
        self._renderer.AddActor(actor)
        self.window = vtkRenderWindow()
        self.window.AddRenderer(self._renderer)

    def set_mesh(self, triangles: NDArray[np.int64]) -> None:
        """Replace the triangles; the vertices have no positions until the next `show`."""
        self._triangles = triangles
        cells = vtkCellArray()
        cells.SetData(3, _as_vtk(triangles.ravel()))
        self._data.Initialize()
        self._data.SetPoints(vtkPoints())
        self._data.SetPolys(cells)

    def show(self, positions: Array, colours: Colours | None, *, on_triangles: bool = False) -> None:
        """Set positions and colours.

        Parameters
        ----------
        positions : (V, 3) array
            [m]
        colours : (V, 3) or (F, 3) uint8 array, optional
            Of the vertices or of the triangles; else the cloth has one colour.
        on_triangles : bool
        """
        # new arrays each time: a page may still fetch those of the previous state
        data, vertices, cells = self._data, self._data.GetPointData(), self._data.GetCellData()
        data.GetPoints().SetData(_as_vtk(positions.astype(np.float32)))
        data.GetPoints().Modified()
        normals = _as_vtk(vertex_normals(positions, self._triangles).astype(np.float32))
        normals.SetName("Normals")
        vertices.SetNormals(normals)
        vertices.SetScalars(None)
        cells.SetScalars(None)
        self._mapper.SetScalarVisibility(colours is not None)
        if colours is not None:
            scalars = _as_vtk(colours)
            scalars.SetName("colours")
            if on_triangles:
                cells.SetScalars(scalars)
                self._mapper.SetScalarModeToUseCellData()
            else:
                vertices.SetScalars(scalars)
                self._mapper.SetScalarModeToUsePointData()
        data.Modified()

    def show_edges(self, shown: bool) -> None:
        """Show or hide the edges of the triangles."""
        self._look.SetEdgeVisibility(shown)

    def look_from(self, view: PerspectiveCamera) -> None:
        """Move the camera."""
        camera = self._renderer.GetActiveCamera()
        camera.SetPosition(*view.position)
        camera.SetFocalPoint(*view.target)
        camera.SetViewUp(*view.up)
        camera.SetViewAngle(view.angle)


def _as_vtk(values: NDArray[Any]) -> Any:
    """A copy as VTK array."""
    convert: Any = numpy_to_vtkIdTypeArray if values.dtype == np.int64 else numpy_to_vtk
    return convert(np.ascontiguousarray(values), deep=True)
