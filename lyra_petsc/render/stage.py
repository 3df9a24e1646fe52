"""The scene that is drawn: sheet, light, floor, handles, wind, bar and label."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.render.camera import View
from lyra_petsc.render.ground import Bounds, Ground
from lyra_petsc.render.held import HeldVertices
from lyra_petsc.render.opengl import import_pyvista
from lyra_petsc.render.quantities import Quantity
from lyra_petsc.render.surface import Surface
from lyra_petsc.render.window import image_of

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

SKY, HORIZON = "#d9e2ec", "#ecebe8"
INK = "#2b2f36"
HANDLE_COLOR, WIND_COLOR = "#30343b", "#6d8fae"
MAP, SIGNED_MAP = "viridis", "coolwarm"


@dataclass(frozen=True)
class Look:
    """What is shown.

    Attributes
    ----------
    size : (int, int)
        Width and height [pixels].
    colors : (str, str)
        Front and back of the sheet.
    quantity : Quantity or None
        What the sheet is coloured by.
    limits : (float, float)
        Of the colours, with a quantity.
    texture : (h, w, 3) uint8 or None
        Picture on the sheet.
    corner_uv : (F, 3, 2) float64 or None
        Its coordinates.
    held : HeldVertices or None
        Handles to draw.
    wind : (3,) float64 or None
        Its velocity [m/s], to draw.
    ground, label : bool
        Whether there is a floor, and the time in a corner.
    unit : str
        Of the time; empty: it is a load factor.
    decimals : int
        That the time is shown with.
    """

    size: tuple[int, int]
    colors: tuple[str, str]
    quantity: Quantity | None = None
    limits: tuple[float, float] = (0.0, 1.0)
    texture: Image | None = None
    corner_uv: Array | None = None
    held: HeldVertices | None = None
    wind: Array | None = None
    ground: bool = True
    label: bool = True
    unit: str = "s"
    decimals: int = 2


class Stage:
    """Draws states, one after another, in one window.

    Parameters
    ----------
    look : Look
    view : View
    bounds : Bounds
        Around the whole motion.
    triangles : (F, 3) int64
    n_vertices : int
    """

    def __init__(
        self, look: Look, view: View, bounds: Bounds, triangles: NDArray[np.int64], n_vertices: int
    ) -> None:
        self._look, self._bounds = look, bounds
        self._pyvista = pyvista = import_pyvista()
        self._surface = Surface(triangles, n_vertices, look.corner_uv if look.texture is not None else None)
        self._plotter = plotter = pyvista.Plotter(off_screen=True, window_size=look.size, lighting="none")
        plotter.set_background(HORIZON, top=SKY)
        # as smooth as several samples a pixel, which cost a software renderer half as much again
        plotter.disable_anti_aliasing()
        plotter.renderer.SetUseFXAA(True)
        plotter.camera.position, plotter.camera.focal_point = tuple(view.position), tuple(view.target)
        plotter.camera.up, plotter.camera.view_angle = tuple(view.up), view.angle
        plotter.camera.SetWindowCenter(0.0, -view.raised)
        self._scale = look.size[1] / 720.0
        key = self._add_lights(view)
        points = np.zeros((len(self._surface.source), 3))
        self._sheet = pyvista.PolyData.from_regular_faces(points, self._surface.corners)
        self._add_sheet()
        self._ground = None
        if look.ground:
            self._ground = Ground(bounds, triangles, n_vertices, key)
            self._floor = plotter.add_mesh(self._ground.corners(), color="white", lighting=False)
        if look.held is not None:
            self._handles = pyvista.PolyData(np.zeros((1, 3)))
            self._rods = pyvista.PolyData(np.zeros((1, 3)))
            self._rods.verts = np.zeros(0, dtype=np.int64)
            width = 5.0 * self._scale
            plotter.add_mesh(
                self._handles,
                color=HANDLE_COLOR,
                style="points",
                point_size=1.8 * width,
                render_points_as_spheres=True,
                reset_camera=False,
            )
            plotter.add_mesh(
                self._rods,
                color=HANDLE_COLOR,
                style="wireframe",
                line_width=width,
                render_lines_as_tubes=True,
                reset_camera=False,
            )
        if look.wind is not None:
            plotter.add_mesh(self._wind_arrows(look.wind), color=WIND_COLOR, ambient=0.35, reset_camera=False)
        self._text = plotter.add_text(
            " ", position=(18 * self._scale, 14 * self._scale), font_size=1, color=INK, font="arial"
        )
        self._text.prop.font_size = round(25 * self._scale)
        self._first = True

    def image(self, state: int, time: float, x: Array) -> Image:
        """(height, width, 3) picture of a state.

        Parameters
        ----------
        state : int
            Its number.
        time : float
            [s].
        x : (V, 3) float64
            Positions [m].
        """
        look = self._look
        self._sheet.points = self._surface.points(x)
        self._sheet.point_data.active_normals = self._surface.normals(x).astype(np.float32)
        if look.quantity is not None:
            values = look.quantity.values(state)
            if look.quantity.on_triangles:
                self._sheet.cell_data["colour"] = values
            else:
                self._sheet.point_data["colour"] = values[self._surface.source]
        if self._ground is not None:
            floor = self._pyvista.Texture(self._ground.picture(x))
            floor.interpolate = True
            self._floor.texture = floor
        if look.held is not None:
            self._move_handles(look.held, time, x)
        name = "t" if look.unit else "load"
        text = f"{name} = {time:.{look.decimals}f} {look.unit}"
        self._text.input = text if look.label else ""
        if self._first:
            self._plotter.show(auto_close=False)
            self._first = False
        self._plotter.reset_camera_clipping_range()
        self._plotter.render()
        return image_of(self._plotter)

    def close(self) -> None:
        """Give the windows back."""
        self._plotter.close()
        if self._ground is not None:
            self._ground.close()

    def _add_sheet(self) -> None:
        look = self._look
        common: dict[str, Any] = {
            "interpolation": "phong",
            "ambient": 0.2,
            "diffuse": 0.8,
            "specular": 0.08,
            "specular_power": 14.0,
            "reset_camera": False,
        }
        if look.quantity is not None:
            # colours must be told apart in the shade, too
            common |= {"ambient": 0.45, "diffuse": 0.6, "specular": 0.05}
            on = self._sheet.cell_data if look.quantity.on_triangles else self._sheet.point_data
            on["colour"] = np.zeros(
                self._sheet.n_cells if look.quantity.on_triangles else self._sheet.n_points
            )
            self._plotter.add_mesh(
                self._sheet,
                scalars="colour",
                clim=look.limits,
                cmap=SIGNED_MAP if look.quantity.signed else MAP,
                show_scalar_bar=False,
                **common,
            )
            self._add_bar(look.quantity)
        elif look.texture is not None and look.corner_uv is not None:
            self._sheet.active_texture_coordinates = self._surface.uv
            texture = self._pyvista.Texture(look.texture)
            texture.interpolate = True
            # repeated, its left edge would shine through on the right
            texture.repeat = bool(look.corner_uv.min() < 0.0 or look.corner_uv.max() > 1.0)
            self._plotter.add_mesh(self._sheet, texture=texture, color="white", **common)
        else:
            front, back = look.colors
            self._plotter.add_mesh(
                self._sheet, color=front, backface_params={**_only_light(common), "color": back}, **common
            )

    def _add_bar(self, quantity: Quantity) -> None:
        left, width, top = 0.64, 0.32, 0.125
        title = self._plotter.add_text(
            quantity.label, position=(left, top), viewport=True, font_size=1, color=INK
        )
        title.prop.font_size = round(25 * self._scale)
        self._plotter.add_scalar_bar(
            title="",
            vertical=False,
            width=width,
            height=0.07,
            position_x=left,
            position_y=0.04,
            n_labels=5,
            fmt="%.3g",
            color=INK,
            font_family="arial",
            label_font_size=round(20 * self._scale),
        )

    def _add_lights(self, view: View) -> Array:
        """The lights about the camera; the direction of the main one."""
        sight = view.position - view.target
        up = self._bounds.axes[2]
        level = sight - (sight @ up) * up
        front = level / np.linalg.norm(level) if np.linalg.norm(level) > 1e-6 else self._bounds.axes[1]
        right = np.cross(up, front)
        key = _towards(front, right, up, azimuth=-40.0, elevation=55.0)
        lights = [
            (key, 0.76),
            (_towards(front, right, up, azimuth=55.0, elevation=20.0), 0.3),
            (_towards(front, right, up, azimuth=-10.0, elevation=10.0), 0.2),
            (_towards(front, right, up, azimuth=10.0, elevation=-50.0), 0.22),  # from the floor
        ]
        for towards, intensity in lights:
            self._plotter.add_light(
                self._pyvista.Light(position=tuple(towards), focal_point=(0, 0, 0), intensity=intensity)
            )
        return key

    def _move_handles(self, held: HeldVertices, time: float, x: Array) -> None:
        vertices, edges = held.at(time)
        single = np.setdiff1d(vertices, edges)
        self._handles.points = self._rods.points = x
        self._handles.verts = np.column_stack([np.ones_like(single), single]).ravel()
        self._rods.lines = np.column_stack([np.full(len(edges), 2), edges]).ravel()

    def _wind_arrows(self, wind: Array) -> Any:
        starts, arrow = wind_arrows(self._bounds, wind)
        cloud = self._pyvista.PolyData(starts)
        cloud["along"] = np.tile(arrow, (len(starts), 1))
        shape = self._pyvista.Arrow(tip_length=0.22, tip_radius=0.045, shaft_radius=0.014)
        return cloud.glyph(orient="along", scale=False, factor=float(np.linalg.norm(arrow)), geom=shape)


def wind_arrows(bounds: Bounds, wind: Array) -> tuple[Array, Array]:
    """Feet (n, 3) of arrows upwind of the motion, and the arrow (3,), all [m]."""
    length = 0.16 * bounds.size
    towards = wind / np.linalg.norm(wind)
    middle = (bounds.low + bounds.high) / 2.0 @ bounds.axes
    corners = bounds.point(np.array(list(np.ndindex(2, 2, 2)), dtype=float))
    upwind = middle + towards * ((corners - middle) @ towards).min()
    across = np.cross(towards, bounds.axes[2])
    across = across / np.linalg.norm(across) if np.linalg.norm(across) > 1e-6 else bounds.axes[0]
    over = np.cross(across, towards)
    steps = 0.14 * bounds.size * np.array([-1.0, 0.0, 1.0])
    feet = [upwind - 1.3 * length * towards + a * across + b * over for a in steps for b in steps]
    return np.array(feet), length * towards


def _towards(front: Array, right: Array, up: Array, *, azimuth: float, elevation: float) -> Array:
    a, e = math.radians(azimuth), math.radians(elevation)
    return math.cos(e) * (math.cos(a) * front + math.sin(a) * right) + math.sin(e) * up


def _only_light(common: dict[str, Any]) -> dict[str, Any]:
    return {key: common[key] for key in ("interpolation", "ambient", "diffuse", "specular", "specular_power")}
