"""The cloth as VTK objects, which trame sends to the page; nothing is drawn on this side."""

from __future__ import annotations

from typing import Any

import numpy as np
import vtkmodules.vtkRenderingOpenGL2  # noqa: F401  (it brings the windows)
from numpy.typing import NDArray
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
from vtkmodules.vtkCommonCore import vtkLogger, vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
from vtkmodules.vtkRenderingCore import vtkActor, vtkPolyDataMapper, vtkRenderer, vtkRenderWindow

from lyra_petsc.render.camera import View
from lyra_petsc.render.surface import Surface
from lyra_petsc.view.palette import Colours

Array = NDArray[np.float64]

BACKGROUND = (0.955, 0.96, 0.97)
PLAIN = (0.77, 0.34, 0.28)
EDGES = (0.15, 0.15, 0.18)


class Cloth:
    """Triangles that move and change their colours.

    Parameters
    ----------
    triangles : (F, 3) int64
    n_vertices : int

    Attributes
    ----------
    window : vtkRenderWindow
    """

    def __init__(self, triangles: NDArray[np.int64], n_vertices: int) -> None:
        vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)  # no display is nothing to worry about
        self._data = vtkPolyData()
        self.set_mesh(triangles, n_vertices)
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

    def set_mesh(self, triangles: NDArray[np.int64], n_vertices: int) -> None:
        """Replace the triangles; the vertices have no place until the next `show`."""
        self._surface = Surface(triangles, n_vertices)
        cells = vtkCellArray()
        cells.SetData(3, _as_vtk(triangles.ravel()))
        self._data.Initialize()
        self._data.SetPoints(vtkPoints())
        self._data.SetPolys(cells)

    def show(self, positions: Array, colours: Colours | None, *, on_triangles: bool = False) -> None:
        """Put the cloth there.

        Parameters
        ----------
        positions : (V, 3) array
            [m]
        colours : (V, 3) or (F, 3) uint8 array, optional
            Of the vertices or of the triangles; without it the cloth is plain.
        on_triangles : bool
        """
        # new arrays each time: the page may still ask for those of the state before
        data, vertices, cells = self._data, self._data.GetPointData(), self._data.GetCellData()
        data.GetPoints().SetData(_as_vtk(positions.astype(np.float32)))
        data.GetPoints().Modified()
        normals = _as_vtk(self._surface.normals(positions).astype(np.float32))
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
        """Draw the edges of the triangles, or not."""
        self._look.SetEdgeVisibility(shown)

    def look_from(self, view: View) -> None:
        """Move the camera."""
        camera = self._renderer.GetActiveCamera()
        camera.SetPosition(*view.position)
        camera.SetFocalPoint(*view.target)
        camera.SetViewUp(*view.up)
        camera.SetViewAngle(view.angle)


def _as_vtk(values: NDArray[Any]) -> Any:
    """A copy as VTK's array."""
    convert: Any = numpy_to_vtkIdTypeArray if values.dtype == np.int64 else numpy_to_vtk
    return convert(np.ascontiguousarray(values), deep=True)
