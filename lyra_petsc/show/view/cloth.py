"""The cloth as VTK objects, which trame sends to the page and the browser draws."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import vtkmodules.vtkRenderingOpenGL2  # noqa: F401  (registers the windows)
from numpy.typing import NDArray
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
from vtkmodules.vtkCommonCore import vtkLogger, vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
from vtkmodules.vtkRenderingCore import vtkActor, vtkPolyDataMapper, vtkRenderer, vtkRenderWindow

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.show.render.camera import PerspectiveCamera
from lyra_petsc.show.render.sheet_geometry import vertex_normals
from lyra_petsc.show.view.page_content import Colours

if TYPE_CHECKING:
    from lyra_petsc.show.obstacle_surfaces import ObstacleSurface


BACKGROUND = (0.955, 0.96, 0.97)
PLAIN = (0.77, 0.34, 0.28)
EDGES = (0.15, 0.15, 0.18)
HELD, WIND, MARK = (0.19, 0.2, 0.23), (0.43, 0.56, 0.68), (0.9, 0.0, 0.5)
OBSTACLE = (0.6, 0.63, 0.66)


class Cloth:
    """The scene of the page: cloth, obstacles, handles, wind and camera.

    Parameters
    ----------
    triangles : (F, 3) int64

    Attributes
    ----------
    window : vtkRenderWindow
    """

    def __init__(self, triangles: Ints) -> None:
        vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)  # VTK would warn of a missing display
        self._data = vtkPolyData()
        self.set_mesh(triangles)
        self._renderer = vtkRenderer()
        self._renderer.SetBackground(*BACKGROUND)
        actor, self._mapper = self._add_actor(self._data, PLAIN)
        self._mapper.SetColorModeToDirectScalars()
        self._look = actor.GetProperty()
        self._look.SetEdgeColor(*EDGES)
        self._look.SetAmbient(0.4)
        self._look.SetDiffuse(0.65)
        self._look.SetSpecular(0.08)
        self._look.SetSpecularPower(20.0)
        self._held, self._wind, self._mark = (self._add_points(color) for color in (HELD, WIND, MARK))
        self._obstacles: list[tuple[ObstacleSurface, vtkPolyData, vtkActor]] = []
        self.window = vtkRenderWindow()
        self.window.AddRenderer(self._renderer)

    def _add_points(self, color: tuple[float, float, float]) -> vtkPolyData:
        """Add an empty set of points and lines of one colour."""
        data = vtkPolyData()
        data.SetPoints(vtkPoints())
        look = self._add_actor(data, color)[0].GetProperty()
        look.SetLighting(False)
        look.SetPointSize(9.0)
        look.SetLineWidth(4.0)
        return data

    def _add_actor(
        self, data: vtkPolyData, color: tuple[float, float, float]
    ) -> tuple[vtkActor, vtkPolyDataMapper]:
        """Add an actor that draws ``data`` in one colour; returns the actor and its mapper."""
        mapper, actor = vtkPolyDataMapper(), vtkActor()
        mapper.SetInputData(data)
        actor.SetMapper(mapper)
        actor.GetProperty().SetColor(*color)
        self._renderer.AddActor(actor)
        return actor, mapper

    def set_obstacles(self, obstacles: list[ObstacleSurface]) -> None:
        """Replace the obstacles; they have no positions until `show_obstacles`."""
        for _, _, actor in self._obstacles:
            self._renderer.RemoveActor(actor)
        self._obstacles = []
        for obstacle in obstacles:
            data = vtkPolyData()
            data.SetPoints(vtkPoints())
            data.SetPolys(_triangles(obstacle.triangles))
            actor, _ = self._add_actor(data, OBSTACLE)
            look = actor.GetProperty()
            look.SetOpacity(obstacle.opacity)
            if not obstacle.smooth:
                look.SetInterpolationToFlat()
            self._obstacles.append((obstacle, data, actor))

    def show_obstacles(self, time: float) -> None:
        """Move the obstacles to their positions at a time [s]."""
        for obstacle, data, _ in self._obstacles:
            if obstacle.fixed and data.GetNumberOfPoints():
                continue
            x = obstacle.positions(time)
            _set_points(data, x, vertex_normals(x, obstacle.triangles) if obstacle.smooth else None)
            data.Modified()

    def show_held(self, positions: Array, edges: Ints) -> None:
        """Show held vertices (n, 3) [m] and the edges (k, 2) between them; empty arrays hide them."""
        _set_geometry(self._held, positions, edges)

    def show_wind(self, feet: Array, arrow: Array) -> None:
        """Show equal arrows (3,) that start at ``feet`` (n, 3), both [m]; an empty array hides them."""
        across = np.cross(arrow, [0.3, 0.5, 0.8])
        across *= 0.1 * np.linalg.norm(arrow) / max(float(np.linalg.norm(across)), 1e-300)
        heads = feet + arrow
        barbs = [heads - 0.25 * arrow + side for side in (across, -across)]
        n = np.arange(len(feet))
        ends = [np.column_stack([i * len(feet) + n, len(feet) + n]) for i in (0, 2, 3)]
        _set_geometry(self._wind, np.concatenate([feet, heads, *barbs]), np.concatenate(ends), points=False)

    def mark(self, vertex: int | None) -> None:
        """Mark a vertex of the present state by a pin, visible from both sides; ``None`` removes the mark."""
        if vertex is None:
            # a line of zero length: pages would never receive the colour of an object that is empty at first
            _set_geometry(self._mark, self._positions[[0, 0]], np.array([[0, 1]]), points=False)
            return
        size = np.linalg.norm(self._positions.max(axis=0) - self._positions.min(axis=0))
        pin = 0.02 * size * self._normals[vertex]
        ends = self._positions[vertex] + np.array([pin, -pin])
        _set_geometry(self._mark, ends, np.array([[0, 1]]))

    def set_mesh(self, triangles: Ints) -> None:
        """Replace the triangles (F, 3); the vertices have no positions until the next `show`."""
        self._triangles = triangles
        self._data.Initialize()
        self._data.SetPoints(vtkPoints())
        self._data.SetPolys(_triangles(triangles))

    def show(self, positions: Array, colours: Colours | None, *, on_triangles: bool = False) -> None:
        """Set positions and colours.

        Parameters
        ----------
        positions : (V, 3) array
            [m]
        colours : (V, 3) or (F, 3) uint8 array, optional
            Colours of the vertices or triangles; without them, the cloth has one colour.
        on_triangles : bool
            Whether the colours belong to triangles.
        """
        # new arrays each time, as a page may still fetch those of the previous state
        data, vertices, cells = self._data, self._data.GetPointData(), self._data.GetCellData()
        self._positions, self._normals = positions, vertex_normals(positions, self._triangles)
        _set_points(data, positions, self._normals)
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


def _triangles(corners: Ints) -> vtkCellArray:
    cells = vtkCellArray()
    cells.SetData(3, _as_vtk(corners.ravel()))
    return cells


def _set_points(data: vtkPolyData, x: Array, normals: Array | None = None) -> None:
    """Replace the points (n, 3) [m] of a mesh and, if given, their normals."""
    data.GetPoints().SetData(_as_vtk(x.astype(np.float32)))
    data.GetPoints().Modified()
    if normals is not None:
        array = _as_vtk(normals.astype(np.float32))
        array.SetName("Normals")
        data.GetPointData().SetNormals(array)


def _set_geometry(data: vtkPolyData, x: Array, edges: Ints, *, points: bool = True) -> None:
    """Replace the points ``x`` (n, 3) [m] and lines of a mesh; ``points``: also draw the points."""
    _set_points(data, x.reshape(-1, 3))
    vertices = np.arange(len(x) if points else 0, dtype=np.int64)
    for size, cells, assign in ((1, vertices, data.SetVerts), (2, edges.astype(np.int64), data.SetLines)):
        array = vtkCellArray()
        if len(cells):
            array.SetData(size, _as_vtk(cells.ravel()))
        assign(array)
    data.Modified()


def _as_vtk(values: NDArray[Any]) -> Any:
    """A copy of an array as VTK array."""
    convert: Any = numpy_to_vtkIdTypeArray if values.dtype == np.int64 else numpy_to_vtk
    return convert(np.ascontiguousarray(values), deep=True)
