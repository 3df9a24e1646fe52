"""The floor under the sheet, and the soft shadow on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.render.camera import horizon
from lyra_petsc.render.opengl import import_pyvista
from lyra_petsc.render.window import image_of

Array = NDArray[np.float64]

PIXELS = 512
"""Of the picture on the floor, in each direction."""
BLUR = 0.012
"""Radius of the shadow's soft edge over the side of the floor."""
DARKNESS = 0.42
COLOR = (225, 224, 221)
GAP = 0.02
"""Height of the lowest point over the floor, over the size of the motion."""


@dataclass(frozen=True)
class Bounds:
    """A box around the whole motion, along the axes to the right, towards the front and up.

    Attributes
    ----------
    axes : (3, 3) float64
        Unit vectors as rows.
    low, high : (3,) float64
        Coordinates along them [m].
    """

    axes: Array
    low: Array
    high: Array

    @classmethod
    def axes_of(cls, up: Array) -> Array:
        """(3, 3) the axes that belong to ``up``."""
        return np.array([*horizon(up), up])

    @property
    def size(self) -> float:
        """Diagonal [m]."""
        return float(np.linalg.norm(self.high - self.low))

    def point(self, fractions: Array) -> Array:
        """(n, 3) points [m] at fractions (n, 3) of the box, 0 to 1 inside."""
        inside: Array = (self.low + fractions * (self.high - self.low)) @ self.axes
        return inside


class Ground:
    """A floor that fades into the background, with the shadow of the sheet.

    Parameters
    ----------
    bounds : Bounds
    triangles : (F, 3) int64
    n_vertices : int
    light : (3,) float64
        Unit vector towards the light.
    """

    def __init__(self, bounds: Bounds, triangles: NDArray[np.int64], n_vertices: int, light: Array) -> None:
        self._bounds, self._light = bounds, light
        self._height = bounds.low[2] - GAP * bounds.size
        # how far to the side a shadow falls, at most
        along = bounds.axes @ light
        reach = (bounds.high[2] - self._height) * np.abs(along[:2]).max() / along[2]
        middle = (bounds.low + bounds.high)[:2] / 2.0
        self._centre = middle
        self._half = 0.75 * float(np.linalg.norm((bounds.high - bounds.low)[:2])) + 1.1 * reach
        self._pyvista = pyvista = import_pyvista()
        self._sheet = pyvista.PolyData.from_regular_faces(np.zeros((n_vertices, 3)), triangles)
        self._above = pyvista.Plotter(off_screen=True, window_size=(PIXELS, PIXELS), lighting="none")
        self._above.disable_anti_aliasing()  # it is blurred anyway
        self._above.set_background("black")
        self._above.add_mesh(self._sheet, color="white", lighting=False)
        self._above.camera.parallel_projection = True
        self._above.camera.position, self._above.camera.focal_point = (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)
        self._above.camera.up, self._above.camera.parallel_scale = (0.0, 1.0, 0.0), 1.0
        self._above.camera.clipping_range = (0.1, 2.0)
        self._above.show(auto_close=False)
        self._fade = _fade()

    def corners(self) -> Any:
        """The floor as a mesh with texture coordinates."""
        square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        at = np.column_stack([self._centre + self._half * square, np.full(4, self._height)])
        floor = self._pyvista.PolyData.from_regular_faces(at @ self._bounds.axes, np.array([[0, 1, 2, 3]]))
        floor.active_texture_coordinates = (square + 1.0) / 2.0
        return floor

    def picture(self, x: Array) -> NDArray[np.uint8]:
        """(n, n, 4) floor with the shadow of the sheet at positions ``x`` (V, 3) [m]."""
        from PIL import Image, ImageFilter

        at = x @ self._bounds.axes.T
        along = self._bounds.axes @ self._light
        cast = at[:, :2] - (at[:, 2:] - self._height) * (along[:2] / along[2])
        flat = np.zeros_like(x)
        flat[:, :2] = (cast - self._centre) / self._half
        self._sheet.points = flat
        self._above.render()
        mask = Image.fromarray(image_of(self._above)[:, :, 0])
        soft = np.asarray(mask.filter(ImageFilter.GaussianBlur(BLUR * PIXELS)), dtype=np.float32) / 255.0
        floor = np.empty((PIXELS, PIXELS, 4), dtype=np.uint8)
        floor[:, :, :3] = np.asarray(COLOR, dtype=np.float32) * (1.0 - DARKNESS * soft[:, :, None])
        floor[:, :, 3] = self._fade
        return floor

    def close(self) -> None:
        """Give the window back."""
        self._above.close()


def _fade() -> NDArray[np.uint8]:
    """Opacity of the floor: full in the middle, none at the rim."""
    line = np.linspace(-1.0, 1.0, PIXELS)
    away = np.hypot(line[:, None], line[None, :])
    ramp = np.clip((1.0 - away) / 0.45, 0.0, 1.0)
    return (255.0 * ramp * ramp * (3.0 - 2.0 * ramp)).astype(np.uint8)
