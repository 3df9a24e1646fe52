"""Drawing a state with PyVista: sheet, lights, floor with shadow, handles, wind, colour bar and time."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.scene.time_curve import TimeCurve
from lyra_petsc.show.render.camera import PerspectiveCamera, horizon
from lyra_petsc.show.render.colour_quantities import ColourQuantity, material_coordinates, round_numbers
from lyra_petsc.show.render.opengl import import_pyvista, off_screen_plotter
from lyra_petsc.show.render.render_plan import OBSTACLE_COLOR, RenderPlan, decimals
from lyra_petsc.show.render.sheet_geometry import HeldVertices, sheet_numbers, split_at_seams, vertex_normals

if TYPE_CHECKING:
    from lyra_petsc.show.obstacle_surfaces import ObstacleSurface

Image = NDArray[np.uint8]

SKY, HORIZON = "#d9e2ec", "#ecebe8"
INK = "#2b2f36"
HANDLE_COLOR, WIND_COLOR = "#30343b", "#6d8fae"
MAP, SIGNED_MAP = "viridis", "coolwarm"

OBSTACLE_MARGIN = 0.25
"""Distance from the motion within which large obstacles are in the picture, relative to the motion's size."""

FLOOR_PIXELS = 512
"""Pixels of the floor's texture in each direction."""
BLUR = 0.012
"""Radius of the shadow's soft edge, relative to the side of the floor."""
DARKNESS = 0.42
FLOOR_COLOR = "#e1e0dd"
FLOOR_GAP = 0.02
"""Height of the sheets' lowest point above the floor, relative to the size of the motion."""


@dataclass(frozen=True)
class Bounds:
    """Bounding box of the whole motion, along axes to the right, towards the front and up.

    Attributes
    ----------
    axes : (3, 3) float64
        Unit vectors as rows.
    low, high : (3,) float64
        Smallest and largest coordinates along the axes [m].
    """

    axes: Array
    low: Array
    high: Array

    @classmethod
    def axes_of(cls, up: Array) -> Array:
        """(3, 3) axes for the upward direction ``up`` (3,)."""
        return np.array([*horizon(up), up])

    @property
    def size(self) -> float:
        """Length of the diagonal [m]."""
        return float(np.linalg.norm(self.high - self.low))

    @property
    def middle(self) -> Array:
        """(3,) centre [m] in x, y, z."""
        return (self.low + self.high) / 2.0 @ self.axes

    def including(self, points: Array) -> Bounds:
        """The smallest box that includes this one and points (n, 3) [m]."""
        whole = np.concatenate([points @ self.axes.T, [self.low, self.high]])
        return Bounds(self.axes, whole.min(axis=0), whole.max(axis=0))


def near_obstacle_points(
    obstacles: Iterable[ObstacleSurface], bounds: Bounds, times: Array, normals: Array
) -> Array:
    """(n, 3) outermost points [m] of the obstacles along ``normals`` (m, 3) at some times [s].

    Of an obstacle that extends beyond the size of the motion, points are moved to within `OBSTACLE_MARGIN`.
    """
    margin = OBSTACLE_MARGIN * bounds.size
    points = [np.empty((0, 3))]
    for x in _solid_positions(obstacles, times):
        along = x @ bounds.axes.T
        if np.maximum(bounds.low - along, along - bounds.high).max() > bounds.size:
            along = along.clip(bounds.low - margin, bounds.high + margin)
        near = along @ bounds.axes
        points.append(near[(near @ normals.T).argmax(axis=0)])
    return np.concatenate(points)


def floor_height(obstacles: Iterable[ObstacleSurface], bounds: Bounds, times: Array) -> float:
    """Height [m] of a floor below the sheets' ``bounds``, on which the lowest obstacle stands."""
    heights = [float((x @ bounds.axes[2]).min()) for x in _solid_positions(obstacles, times)]
    return min([float(bounds.low[2]) - FLOOR_GAP * bounds.size, *heights])


def _solid_positions(obstacles: Iterable[ObstacleSurface], times: Array) -> Iterator[Array]:
    """Points (n, 3) [m] of each obstacle but planes, at each time [s] if it moves."""
    for obstacle in obstacles:
        if not obstacle.infinite:
            for time in times[:1] if obstacle.fixed else times:
                yield obstacle.positions(float(time))


class SceneDrawing:
    """An off-screen window in which one state after another is drawn.

    Parameters
    ----------
    plan : RenderPlan
    view : PerspectiveCamera
    bounds : Bounds
        Bounding box of the whole motion.
    quantity : ColourQuantity or None
        The quantity that colours the sheet.
    limits : (float, float)
        Range of the colours.
    wind : TimeCurve or None
        Velocity (3,) of the wind [m/s], if it is drawn.
    obstacles : list of ObstacleSurface
    floor : float
        Height of the floor [m].

    Attributes
    ----------
    plotter : pyvista.Plotter
    """

    def __init__(
        self,
        plan: RenderPlan,
        view: PerspectiveCamera,
        bounds: Bounds,
        quantity: ColourQuantity | None,
        limits: tuple[float, float],
        wind: TimeCurve | None,
        obstacles: list[ObstacleSurface],
        floor: float,
    ) -> None:
        self._plan, self._bounds = plan, bounds
        self._triangles = plan.run.triangles
        self._pyvista = pyvista = import_pyvista()
        self.plotter = plotter = off_screen_plotter(plan.size)
        plotter.set_background(HORIZON, top=SKY)
        plotter.renderer.SetDitherGradient(False)  # pictures would be twice as large
        # FXAA is as smooth as multisampling, with which a software renderer takes 1.5 times as long
        plotter.disable_anti_aliasing()
        plotter.renderer.SetUseFXAA(True)
        plotter.camera_position = [tuple(view.position), tuple(view.target), tuple(view.up)]
        plotter.camera.view_angle = view.angle
        plotter.camera.SetWindowCenter(0.0, -view.raised)
        self._scale = plan.size[1] / 720.0
        key_light = self._add_lights(view)
        self._sheet_actors: list[Any] = []
        self.colour_by(quantity, limits)
        self._obstacles = [(obstacle, self._add_obstacle(obstacle)) for obstacle in obstacles]
        self._ground = None
        has_floor = plan.options.ground and not any(obstacle.infinite for obstacle in obstacles)
        if has_floor and plan.scene.gravity is not None:
            self._ground = Ground(bounds, floor, self._triangles, len(plan.run.rest), key_light)
            self._floor = plotter.add_mesh(self._ground.mesh(), color="white", lighting=False)
        self._held = HeldVertices(plan.run) if plan.options.handles else None
        if self._held is not None:
            self._add_handles()
        self._wind = wind
        if wind is not None:
            self._arrows = _arrow_mesh(pyvista, *wind_arrows(bounds, wind.largest))
            self._arrows_actor = plotter.add_mesh(
                self._arrows, color=WIND_COLOR, ambient=0.35, reset_camera=False
            )
        self._time = self._add_text(" ", (18 * self._scale, 14 * self._scale), font="arial")
        digits = f"{{:.{decimals(plan.run.times)}f}}"
        static = plan.scene.time.static
        self._label = f"load = {digits}" if static else f"t = {digits} s"
        self._first, self._placed = True, False

    def image(self, state: int) -> Image:
        """(height, width, 3) picture of a state, given by its number."""
        self.show(state)
        if self._first:
            self.plotter.show(auto_close=False)
            self._first = False
        self.plotter.reset_camera_clipping_range()
        self.plotter.render()
        return np.ascontiguousarray(self.plotter.image)

    def show(self, state: int) -> None:
        """Move and colour what is drawn to a state, given by its number, without drawing it."""
        run = self._plan.run
        time, x = float(run.times[state]), run.positions[state]
        normals = vertex_normals(x, self._triangles)[self._source].astype(np.float32)
        for sheet in self._sheets:
            sheet.points = x[self._source]
            sheet.point_data.active_normals = normals
        if self._quantity is not None:
            values = self._quantity.values(state)
            if self._quantity.on_triangles:
                self._sheets[0].cell_data["colour"] = values
            else:
                self._sheets[0].point_data["colour"] = values[self._source]
        for obstacle, mesh in self._obstacles:
            if not (obstacle.fixed and self._placed):
                mesh.points = obstacle.positions(time)
                if obstacle.smooth:
                    normals = vertex_normals(np.asarray(mesh.points), obstacle.triangles)
                    mesh.point_data.active_normals = normals.astype(np.float32)
        self._placed = True
        if self._ground is not None:
            floor = self._pyvista.Texture(self._ground.picture(x))
            floor.interpolate = True
            self._floor.texture = floor
        if self._held is not None:
            vertices, edges = self._held.at(time)
            single = np.setdiff1d(vertices, edges)
            self._handles.points = self._rods.points = x
            self._handles.verts = np.column_stack([np.ones_like(single), single]).ravel()
            self._rods.lines = np.column_stack([np.full(len(edges), 2), edges]).ravel()
        if self._wind is not None and len(self._wind.times) > 1:
            self._show_wind(self._wind.at(time), self._wind.largest)
        self._time.input = self._label.format(time) if self._plan.options.label else ""

    def _show_wind(self, velocity: Array, largest: Array) -> None:
        """Draw arrows of a length in proportion to the wind's velocity (3,) [m/s]; none if it is calm."""
        self._arrows_actor.visibility = bool(velocity.any())
        if velocity.any():
            feet, arrow = wind_arrows(self._bounds, velocity)
            part = float(np.linalg.norm(velocity) / np.linalg.norm(largest))
            self._arrows.points = _arrow_mesh(self._pyvista, feet, part * arrow).points

    def close(self) -> None:
        """Close the windows."""
        self.plotter.close()
        if self._ground is not None:
            self._ground.close()

    def colour_by(self, quantity: ColourQuantity | None, limits: tuple[float, float]) -> None:
        """Draw the sheets anew, in the colours of a quantity, of the texture, or of their own.

        All triangles are one mesh or, if each sheet has its colours, one for each pair of colours.
        """
        for actor in self._sheet_actors:
            self.plotter.remove_actor(actor, reset_camera=False, render=False)
        for title in list(self.plotter.scalar_bars.keys()):
            self.plotter.remove_scalar_bar(title, render=False)
        self._quantity, plan, triangles = quantity, self._plan, self._triangles
        self._source, corners, uv = np.arange(len(plan.run.rest)), triangles, None
        if plan.texture is not None:
            uv = plan.run.corner_uv
            corner_uv = _to_unit_square(material_coordinates(plan.run)) if uv is None else uv
            self._source, corners, uv = split_at_seams(triangles, corner_uv)
        pair = np.zeros(len(triangles), dtype=np.int64)
        if len(plan.colors) > 1:
            pair = sheet_numbers(plan.run) % len(plan.colors)
        pairs, points = np.unique(pair), np.zeros((len(self._source), 3))
        make_sheet = self._pyvista.PolyData.from_regular_faces
        self._sheets = [make_sheet(points, corners[pair == number]) for number in pairs]
        sheet = self._sheets[0]
        light: dict[str, Any] = {"interpolation": "phong", "specular_power": 14.0}
        light |= {"ambient": 0.24, "diffuse": 0.8, "specular": 0.08}
        looks: list[dict[str, Any]]
        if quantity is not None:
            # brighter, so that colours can be distinguished in the shade
            light |= {"ambient": 0.45, "diffuse": 0.6, "specular": 0.05}
            if quantity.on_triangles:
                sheet.cell_data["colour"] = np.zeros(sheet.n_cells)
            else:
                sheet.point_data["colour"] = np.zeros(sheet.n_points)
            colours = SIGNED_MAP if quantity.signed else MAP
            looks = [{"scalars": "colour", "clim": limits, "cmap": colours, "show_scalar_bar": False}]
        elif uv is not None:
            sheet.active_texture_coordinates = uv
            texture = self._pyvista.Texture(plan.texture)
            texture.interpolate = True
            # a repeated texture would show its left edge at the right edge
            texture.repeat = bool(uv.min() < 0.0 or uv.max() > 1.0)
            looks = [{"texture": texture, "color": "white"}]
        else:
            shown = [plan.colors[number] for number in pairs]
            looks = [{"color": front, "backface_params": {**light, "color": back}} for front, back in shown]
        self._sheet_actors = [
            self.plotter.add_mesh(sheet, reset_camera=False, render=False, **light, **look)
            for sheet, look in zip(self._sheets, looks, strict=True)
        ]
        if quantity is not None:
            self._sheet_actors.append(self._add_bar(quantity, limits))

    def _add_obstacle(self, obstacle: ObstacleSurface) -> Any:
        """Add an obstacle and return its mesh, whose points `image` moves."""
        points = obstacle.positions(0.0)
        mesh = self._pyvista.PolyData.from_regular_faces(points, obstacle.triangles)
        look = {"ambient": 0.3, "diffuse": 0.7, "interpolation": "phong" if obstacle.smooth else "flat"}
        self.plotter.add_mesh(
            mesh, color=OBSTACLE_COLOR, opacity=obstacle.opacity, reset_camera=False, **look
        )
        return mesh

    def _add_bar(self, quantity: ColourQuantity, limits: tuple[float, float]) -> Any:
        """Add the colour bar and its title, which is returned."""
        left = 0.64
        place = {"width": 0.32, "height": 0.07, "position_x": left, "position_y": 0.04}
        font = {"color": INK, "font_family": "arial", "label_font_size": round(20 * self._scale)}
        title = self._add_text(quantity.label, (left, 0.125), viewport=True)
        bar = self.plotter.add_scalar_bar(title="", vertical=False, fmt="%g", **place, **font)
        bar.SetCustomLabels(self._pyvista.convert_array(round_numbers(*limits)))
        bar.SetUseCustomLabels(True)
        return title

    def _add_text(self, text: str, position: tuple[float, float], **options: Any) -> Any:
        added = self.plotter.add_text(text, position=position, font_size=1, color=INK, **options)
        added.prop.font_size = round(25 * self._scale)
        return added

    def _add_lights(self, view: PerspectiveCamera) -> Array:
        """Add four lights, placed relative to the camera; returns the direction of the main light."""
        sight = view.position - view.target
        up = self._bounds.axes[2]
        level = sight - (sight @ up) * up
        front = level / np.linalg.norm(level) if np.linalg.norm(level) > 1e-6 else self._bounds.axes[1]
        right = np.cross(up, front)
        lights = [(-35.0, 55.0, 0.68), (50.0, 15.0, 0.28), (0.0, 5.0, 0.36), (10.0, -55.0, 0.3)]
        directions: list[Array] = []
        for azimuth, elevation, intensity in lights:
            a, e = math.radians(azimuth), math.radians(elevation)
            towards = math.cos(e) * (math.cos(a) * front + math.sin(a) * right) + math.sin(e) * up
            self.plotter.add_light(self._pyvista.Light(position=tuple(towards), intensity=intensity))
            directions.append(towards)
        return directions[0]

    def _add_handles(self) -> None:
        """Add the held vertices as spheres and the held edges as rods."""
        self._handles = self._pyvista.PolyData(np.zeros((1, 3)))
        self._rods = self._pyvista.PolyData(np.zeros((1, 3)))
        self._rods.verts = np.zeros(0, dtype=np.int64)
        width = 5.0 * self._scale
        spheres = {"style": "points", "point_size": 1.8 * width, "render_points_as_spheres": True}
        tubes = {"style": "wireframe", "line_width": width, "render_lines_as_tubes": True}
        for mesh, style in ((self._handles, spheres), (self._rods, tubes)):
            self.plotter.add_mesh(mesh, color=HANDLE_COLOR, reset_camera=False, **style)


class Ground:
    """A floor that fades into the background, with the shadow of the sheet.

    Parameters
    ----------
    bounds : Bounds
    height : float
        [m]
    triangles : (F, 3) int64
    n_vertices : int
    light : (3,) float64
        Unit vector towards the light.
    """

    def __init__(self, bounds: Bounds, height: float, triangles: Ints, n_vertices: int, light: Array) -> None:
        self._bounds, self._height = bounds, height
        towards = bounds.axes @ light
        self._slope = towards[:2] / towards[2]
        # largest sideways displacement of the shadow
        shift = (bounds.high[2] - self._height) * np.abs(self._slope).max()
        self._centre = (bounds.low + bounds.high)[:2] / 2.0
        self._half = 0.75 * float(np.linalg.norm((bounds.high - bounds.low)[:2])) + 1.1 * shift
        self._pyvista = pyvista = import_pyvista()
        # the sheet projected onto the floor, seen from above: white on black
        self._shadow = pyvista.PolyData.from_regular_faces(np.zeros((n_vertices, 3)), triangles)
        self._above = above = off_screen_plotter((FLOOR_PIXELS, FLOOR_PIXELS))
        above.disable_anti_aliasing()  # the shadow is blurred anyway
        above.set_background("black")
        above.add_mesh(self._shadow, color="white", lighting=False)
        above.camera.parallel_projection = True
        above.camera.position, above.camera.focal_point = (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)
        above.camera.up, above.camera.parallel_scale = (0.0, 1.0, 0.0), 1.0
        above.camera.clipping_range = (0.1, 2.0)
        above.show(auto_close=False)
        # opacity: 1 in the middle, 0 at the rim
        line = np.linspace(-1.0, 1.0, FLOOR_PIXELS)
        ramp = np.clip((1.0 - np.hypot(line[:, None], line[None, :])) / 0.45, 0.0, 1.0)
        self._opacity = (255.0 * ramp * ramp * (3.0 - 2.0 * ramp)).astype(np.uint8)

    def mesh(self) -> Any:
        """The floor as a square with texture coordinates."""
        square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        at = np.column_stack([self._centre + self._half * square, np.full(4, self._height)])
        floor = self._pyvista.PolyData.from_regular_faces(at @ self._bounds.axes, np.array([[0, 1, 2, 3]]))
        floor.active_texture_coordinates = (square + 1.0) / 2.0
        return floor

    def picture(self, x: Array) -> Image:
        """(n, n, 4) texture of the floor with the shadow of the sheet at positions ``x`` (V, 3) [m]."""
        from PIL import Image as Pictures
        from PIL import ImageColor, ImageFilter

        at = x @ self._bounds.axes.T
        flat = np.zeros_like(x)
        flat[:, :2] = (at[:, :2] - (at[:, 2:] - self._height) * self._slope - self._centre) / self._half
        self._shadow.points = flat
        self._above.render()
        mask = Pictures.fromarray(np.ascontiguousarray(self._above.image[:, :, 0]))
        blurred = mask.filter(ImageFilter.GaussianBlur(BLUR * FLOOR_PIXELS))
        shade = DARKNESS * (np.asarray(blurred, dtype=np.float32) / 255.0)
        floor = np.empty((FLOOR_PIXELS, FLOOR_PIXELS, 4), dtype=np.uint8)
        floor[:, :, :3] = np.array(ImageColor.getrgb(FLOOR_COLOR), dtype=np.float32) * (
            1.0 - shade[:, :, None]
        )
        floor[:, :, 3] = self._opacity
        return floor

    def close(self) -> None:
        """Close the window."""
        self._above.close()


def wind_arrows(bounds: Bounds, wind: Array) -> tuple[Array, Array]:
    """Starting points (n, 3) of arrows upwind of the motion, and the vector (3,) of all arrows [m]."""
    length = 0.16 * bounds.size
    towards = wind / np.linalg.norm(wind)
    middle = bounds.middle
    fractions = np.array(list(np.ndindex(2, 2, 2)), dtype=float)
    corners = (bounds.low + fractions * (bounds.high - bounds.low)) @ bounds.axes
    upwind = middle + towards * ((corners - middle) @ towards).min()
    across = np.cross(towards, bounds.axes[2])
    across = across / np.linalg.norm(across) if np.linalg.norm(across) > 1e-6 else bounds.axes[0]
    over = np.cross(across, towards)
    steps = 0.14 * bounds.size * np.array([-1.0, 0.0, 1.0])
    feet = [upwind - 1.3 * length * towards + a * across + b * over for a in steps for b in steps]
    return np.array(feet), length * towards


def _arrow_mesh(pyvista: Any, feet: Array, arrow: Array) -> Any:
    cloud = pyvista.PolyData(feet)
    cloud["along"] = np.tile(arrow, (len(feet), 1))
    shape = pyvista.Arrow(tip_length=0.22, tip_radius=0.045, shaft_radius=0.014)
    return cloud.glyph(orient="along", scale=False, factor=float(np.linalg.norm(arrow)), geom=shape)


def _to_unit_square(corner_uv: Array) -> Array:
    """Texture coordinates scaled to the unit square, so that a picture covers the sheet once."""
    low, high = corner_uv.min(axis=(0, 1)), corner_uv.max(axis=(0, 1))
    return (corner_uv - low) / np.where(high > low, high - low, 1.0)
