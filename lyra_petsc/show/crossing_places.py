"""The places where a start crosses: a file for ParaView and a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.contact.start_crossings import StartCrossings
from lyra_petsc.errors import InputError
from lyra_petsc.extras import missing_packages
from lyra_petsc.output.file_operations import replace_text
from lyra_petsc.show.render.camera import CameraFit, line_of_sight, up_direction

VTK_FILE, PICTURE_FILE = "crossings.vtk", "crossings.png"

PICTURE_SIZE = 1280, 720
NEIGHBOURHOOD = 0.15
"""Margin of the picture around the places, relative to the size of the sheets."""
SHEET_COLORS = ("#8fb4d9", "#e3c18c", "#9cc9a3", "#c9a6cf", "#d9d27f")
SEGMENT_COLOR, TRIANGLE_COLOR, OBSTACLE_COLOR = "#c4161c", "#e8743b", "#a9a59d"


def write_places(start: StartCrossings, folder: Path) -> str:
    """Write `VTK_FILE`, and `PICTURE_FILE` where the extra ``view`` can draw; returns text about them.

    Raises
    ------
    OutputError
        If a file cannot be written.
    """
    replace_text(folder / VTK_FILE, vtk_text(start))
    written = f"see {folder / VTK_FILE} (ParaView)"
    if missing_packages(("pyvista", "PIL")):
        return f"{written}; a picture needs the extra view"
    from lyra_petsc.show.render.image_files import write_png
    from lyra_petsc.show.render.opengl import check_opengl

    try:
        check_opengl()
    except InputError:
        return f"{written}; a picture needs OpenGL"
    write_png(folder / PICTURE_FILE, _picture(start))
    return f"{written} and {folder / PICTURE_FILE}"


def _cells(start: StartCrossings) -> tuple[Array, Array, dict[str, Ints]]:
    """Segments (m, 2, 3) and triangles (k, 3, 3) [m], and integers (m + k,) of all of them."""
    points, triangles = start.surface
    segments, corners, rows = [], [], []
    for crossing in start.crossings:
        among = crossing.obstacle < 0 and crossing.others[0] >= 0
        second = start.sheet[crossing.others] if among else np.full_like(crossing.others, -1)
        whole = np.column_stack(
            [
                crossing.triangles,
                crossing.others,
                start.sheet[crossing.triangles],
                second,
                np.full_like(crossing.others, crossing.obstacle),
            ]
        )
        known = np.isfinite(crossing.segments).all(axis=(1, 2))
        segments.append((crossing.segments[known], whole[known]))
        own = points[triangles[crossing.triangles]]
        corners.append((own, whole))
        if among:
            corners.append((points[triangles[crossing.others]], whole[:, [1, 0, 3, 2, 4]]))
    lines, faces = (np.concatenate([part for part, _ in parts]) for parts in (segments, corners))
    rows = np.concatenate([row for _, row in (*segments, *corners)])
    names = "triangle", "other_triangle", "sheet", "other_sheet", "obstacle"
    return lines, faces, dict(zip(names, rows.T, strict=True))


def vtk_text(start: StartCrossings) -> str:
    """A legacy VTK file: the segments in which triangles intersect, and these triangles.

    Cell data are the numbers of triangle and sheet, the same of the other sheet, and the number of the
    obstacle in the scene; -1 where there is none.
    """
    lines, faces, data = _cells(start)
    points = np.concatenate([lines.reshape(-1, 3), faces.reshape(-1, 3)])
    names = "; ".join(f"{number} {name}" for number, name in enumerate(start.names))
    title = f"crossings [m]; sheets: {names}".encode("ascii", "replace").decode()[:250]
    text = ["# vtk DataFile Version 3.0", " ".join(title.split()), "ASCII", "DATASET POLYDATA"]
    text += [f"POINTS {len(points)} double", *(" ".join(map(repr, row)) for row in points.tolist())]
    first = 0
    for kind, cells in (("LINES", lines), ("POLYGONS", faces)):
        size = cells.shape[1]
        numbers = first + np.arange(len(cells) * size).reshape(-1, size)
        first += numbers.size
        if len(cells):
            text += [f"{kind} {len(cells)} {(size + 1) * len(cells)}"]
            text += [f"{size} {' '.join(map(str, row))}" for row in numbers.tolist()]
    count = len(lines) + len(faces)
    text += [f"CELL_DATA {count}", f"FIELD crossings {len(data)}"]
    for name, values in data.items():
        text += [f"{name} 1 {count} int", " ".join(map(str, values.tolist()))]
    return "\n".join(text) + "\n"


def _picture(start: StartCrossings) -> Any:
    """(height, width, 3) picture of the sheets around the places, with the segments in red."""
    from lyra_petsc.show.obstacle_surfaces import shape_surface
    from lyra_petsc.show.render.opengl import import_pyvista, off_screen_plotter

    pyvista, plotter = import_pyvista(), off_screen_plotter(PICTURE_SIZE)
    lines, faces, _ = _cells(start)
    points, triangles = start.surface
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    try:
        plotter.set_background("white")
        plotter.enable_lightkit()
        for number in range(len(start.names)):
            surface = pyvista.PolyData.from_regular_faces(points, triangles[start.sheet == number])
            style = {"opacity": 0.55, "show_edges": True, "edge_color": "#6b7683"}
            plotter.add_mesh(surface, color=SHEET_COLORS[number % len(SHEET_COLORS)], **style)
        bodies = dict(start.obstacles)
        for name, shape in (start.scene.obstacles or {}).items():
            if name not in bodies and shape.plane is None and shape.mesh is None and shape.motion is None:
                bodies[name] = shape_surface(shape)
        for body in bodies.values():
            surface = pyvista.PolyData.from_regular_faces(body.points, body.triangles)
            plotter.add_mesh(surface, color=OBSTACLE_COLOR, opacity=0.35)
        corners = faces.reshape(-1, 3)
        cells = np.arange(len(corners)).reshape(-1, 3)
        marked = pyvista.PolyData.from_regular_faces(corners, cells)
        plotter.add_mesh(marked, color=TRIANGLE_COLOR, opacity=0.8)
        if len(lines):
            cells = np.column_stack([np.full(len(lines), 2), np.arange(2 * len(lines)).reshape(-1, 2)])
            segments = pyvista.PolyData(lines.reshape(-1, 3), lines=cells.ravel())
            plotter.add_mesh(segments, color=SEGMENT_COLOR, line_width=5.0, render_lines_as_tubes=True)
        up = up_direction(start.scene)
        sight = line_of_sight(start.scene, up, [points], triangles)
        fit = CameraFit(start.scene, sight, up, PICTURE_SIZE[0] / PICTURE_SIZE[1])
        view = fit.view((corners @ fit.normals.T).max(axis=0) + NEIGHBOURHOOD * size)
        plotter.camera_position = [tuple(view.position), tuple(view.target), tuple(view.up)]
        plotter.camera.view_angle = view.angle
        plotter.reset_camera_clipping_range()
        return np.ascontiguousarray(plotter.screenshot(return_img=True))
    finally:
        plotter.close()
