"""Published benchmarks of shells with large rotations and of curved shells, with directors on edges."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.experiments.bench import Bench, Trial
from lyra_petsc.experiments.meshes import rectangle
from lyra_petsc.experiments.verification.flat_plates import plate_material
from lyra_petsc.experiments.verification.rods import cantilever, pressed_tip
from lyra_petsc.experiments.verification.verification_case import (
    STATIC,
    Measured,
    grid,
    load_data,
    scene,
    vector_error,
    worst,
)

TABLES = load_data("shells")
LINEAR = TABLES["linear"]

# -- large rotations -----------------------------------------------------------------------------------

INCREMENT = 0.05
"""Increment of the load factor; the tables have multiples of it."""

LENGTHS = {"shear": 10.0, "moment": 12.0}
STRIP = {"young": 1.2e6, "poisson": 0.0, "thickness": 0.1, "density": 1.0}
STIFFNESS = 1.2e6 * 0.1**3 / 12.0
"""Bending stiffness B [N·m]"""


def increments(bench: Bench, content: dict[str, Any], fraction: float) -> Iterator[tuple[float, Trial]]:
    """Step a static scene by equal load increments; yields load factors and equilibria; collective."""
    solver = {"solver": {"force_tolerance": 1e-6}, "petsc": {"ts_adapt_dt_max": fraction, "ksp_rtol": 1e-6}}
    time = STATIC | {"step": fraction}
    with bench.simulation(content | solver | {"gravity": [0, 0, 0], "time": time}) as trial:
        while not trial.simulation.finished:
            yield trial.step().time, trial


def sze_strip(kind: str, n: float, loads: list[dict[str, Any]]) -> dict[str, Any]:
    """A strip of Sze et al., of width 1 m, with n square cells along it."""
    length = LENGTHS[kind]
    mesh = grid(length, 1.0, round(n), round(n / length), "alternating")
    return scene(mesh, STRIP, handles=[{"group": "left", "clamp": True}], loads=loads)


Probe = Callable[[Trial], Array]


def worst_of_table(
    bench: Bench,
    content: dict[str, Any],
    table: str,
    probe: Probe,
    measure: Callable[[Array, Array], list[Measured]],
) -> tuple[list[Measured], Array]:
    """The largest errors over the loads of a table, and the probe at full load; collective.

    ``measure`` compares a probe with the row of the table.
    """
    rows = {round(row[0], 6): np.array(row[1:]) for row in TABLES[table]["rows"]}
    compared, value = [], np.empty(0)
    for factor, trial in increments(bench, content, INCREMENT):
        value, exact = probe(trial), rows.get(round(factor, 6))
        if exact is not None:
            compared.append(measure(value, exact))
    return worst(compared), value


def of_points(points: str, label: str, unit: str) -> Callable[[Array, Array], list[Measured]]:
    """Compares one component of each of some points; ``label`` has a place for the name of the point."""
    return lambda value, exact: [
        Measured(label.format(point), float(one), float(of), unit)
        for point, one, of in zip(points, value, exact, strict=True)
    ]


def tip(length: float) -> Probe:
    """Displacement (−U, W) of the end of a strip along x."""

    def displacement(trial: Trial) -> Array:
        x, _, z = trial.x[np.isclose(trial.start[:, 0], length)].mean(axis=0)
        return np.array([length - x, z])

    return displacement


def _tips(bench: Bench, n: float, kind: str, loads: list[dict[str, Any]]) -> tuple[list[Measured], Array]:
    """Largest error of the tip over the loads of a table, and its displacement at full load."""

    def measure(u: Array, exact: Array) -> list[Measured]:
        return [vector_error("displacement of the tip, worst load of the table", u, exact)]

    strip = sze_strip(kind, n, loads)
    return worst_of_table(bench, strip, f"cantilever_end_{kind}", tip(LENGTHS[kind]), measure)


def sze_end_shear(bench: Bench, n: float) -> Sequence[Measured]:
    loads = [{"group": "right", "force": [0.0, 0.0, 4.0]}]
    tips, end = _tips(bench, n, "shear", loads)
    length, membrane = LENGTHS["shear"], 1.2e6 * 0.1
    exact = cantilever(0.0, 4.0 * length**2 / STIFFNESS, STIFFNESS / (membrane * length**2))
    u = np.array([1.0 - exact.reach, exact.drop]) * length
    return [*tips, vector_error("displacement of the tip at full load", end, u, "m")]


def sze_end_moment(bench: Bench, n: float) -> Sequence[Measured]:
    length = LENGTHS["moment"]
    loads = [{"group": "right", "moment": 2.0 * math.pi * STIFFNESS / length}]
    tips, end = _tips(bench, n, "moment", loads)
    return [*tips, Measured("−U at full load", float(end[0]), length, "m")]


def pressed_strip(bench: Bench, n: float) -> Iterator[Measured]:
    # pressures q L³/B; the second one bends the strip by more than half a circle
    pressures = (6.0, 30.0)
    mesh = grid(1.0, 0.1, round(n), round(0.1 * n), "alternating")
    strip = scene(mesh, plate_material(1e6), handles=[{"group": "left", "clamp": True}])
    content = strip | {"loads": [{"pressure": pressures[-1]}]}
    for factor, trial in increments(bench, content, 0.1):
        load = next((load for load in pressures if math.isclose(load, factor * pressures[-1])), None)
        if load is not None:
            x, z = pressed_tip(load)
            name, exact = f"displacement of the tip, q L³/B = {load:g}", np.array([1.0 - x, z])
            yield vector_error(name, tip(1.0)(trial), exact, "m")


def _line_load(ends: Sequence[int], force: Array) -> list[dict[str, Any]]:
    """Loads that spread a force [N] uniformly over a line of vertices."""
    part = force / (len(ends) - 1)
    return [
        {"nodes": list(ends[1:-1]), "force": (part * (len(ends) - 2)).tolist()},
        {"nodes": [ends[0], ends[-1]], "force": part.tolist()},
    ]


def slit_annulus_scene(bench: Bench, n: int) -> tuple[dict[str, Any], tuple[int, int]]:
    """The plate with n cells across, and the end vertices A and B of its loaded edge; collective."""
    around = round(20 * n / 3)
    flat, faces = rectangle(around, n, 2.0 * math.pi, 1.0)
    radius = 6.0 + 4.0 * flat[:, 1]
    vertices = np.column_stack([radius * np.cos(flat[:, 0]), radius * np.sin(flat[:, 0]), 0.0 * radius])
    edge = [j * (around + 1) for j in range(n + 1)]
    loads = _line_load(edge, np.array([0.0, 0.0, 3.2]))  # 0.8 N/m on 4 m
    material = {"young": 21e6, "poisson": 0.0, "thickness": 0.03, "density": 1.0}
    held = [{"nodes": [vertex + around for vertex in edge], "clamp": True}]
    content = scene(bench.mesh(vertices, faces[:, ::-1]), material, handles=held, loads=loads)
    return content, (edge[0], edge[-1])


DISC = {"young": 1e7, "poisson": 0.3, "thickness": 0.01, "density": 1.0}
"""Material of round plates of the radius 1 m."""


def _disc(bench: Bench, n: float, load: float, step: float, **held: Any) -> float:
    """Deflection [m] at the centre of a disc with n edges along its radius, under ``load`` × E h⁴ [Pa].

    ``held`` are further keys of the handle at its rim; gmsh makes the mesh.
    """
    around = [(0, 0), (1, 0), (0, 1), (-1, 0), (0, -1)]
    lines = [f"Point({k}) = {{{x}, {y}, 0, {1.0 / n!r}}};" for k, (x, y) in enumerate(around, 1)]
    lines += [f"Circle({k}) = {{{k + 1}, 1, {k % 4 + 2}}};" for k in range(1, 5)]
    lines += ["Curve Loop(1) = {1, 2, 3, 4};", "Plane Surface(1) = {1};", "Point{1} In Surface{1};"]
    lines += ['Physical Surface("plate") = {1};', 'Physical Curve("rim") = {1, 2, 3, 4};']
    content = scene(
        bench.gmsh_mesh("\n".join(lines) + "\n"),
        DISC,
        STATIC | {"step": step},
        gravity=[0.0, 0.0, load * DISC["young"] * DISC["thickness"] ** 4],
        handles=[{"group": "rim"} | held],
    )
    with bench.simulation(content) as trial:
        middle = int(np.argmin(np.linalg.norm(trial.start, axis=1)))
        return float(trial.run().x[middle, 2])


def clamped_disc(bench: Bench, n: float) -> Iterator[Measured]:
    # deflections over the thickness h, by q a⁴/(E h⁴) of a load q [Pa] on the radius a, for ν = 0.3
    for load, exact in {3.0: 0.45884, 15.0: 1.30207}.items():
        deflection = _disc(bench, n, load, 0.25, clamp=True) / DISC["thickness"]
        yield Measured(f"deflection over thickness, load {load:g} E h⁴/a⁴", deflection, exact)


def supported_disc(bench: Bench, n: float) -> Iterator[Measured]:
    load, poisson = 1e-4, DISC["poisson"]
    deflection = _disc(bench, n, load, 1.0) / DISC["thickness"] / load
    exact = 12.0 * (1.0 - poisson**2) / 64.0 * (5.0 + poisson) / (1.0 + poisson)
    yield Measured("deflection over q a⁴/(E h³)", deflection, exact)


def slit_annulus(bench: Bench, n: float) -> Sequence[Measured]:
    plate, ends = slit_annulus_scene(bench, round(n))
    measure = of_points("AB", "height of {}, worst load of the table", "m")

    def heights(trial: Trial) -> Array:
        return trial.x[list(ends), 2]

    worst_errors, height = worst_of_table(bench, plate, "slit_annulus", heights, measure)
    full = np.array(TABLES["slit_annulus"]["kirchhoff_love"])
    return worst_errors + of_points("AB", "height of {} at full load", "m")(height, full)


# -- curved shells, linear -----------------------------------------------------------------------------

PATTERNS = ("diagonal", "alternating")


def plane_box(axis: str, at: float, size: float) -> list[list[float]]:
    """Opposite corners of a box that contains the vertices on a coordinate plane."""
    far = 1e4
    # tolerance of a coordinate over the size of the shell within which vertices count as on a plane
    beside = 1e-6
    return [
        [at - beside * size if direction == axis else -far for direction in "xyz"],
        [at + beside * size if direction == axis else far for direction in "xyz"],
    ]


def symmetric(axes: str, size: float) -> list[dict[str, Any]]:
    """Symmetry handles of the vertices on planes through the origin, normal to these axes."""
    return [{"box": plane_box(axis, 0.0, size), "symmetry": axis} for axis in axes]


Surface = Callable[[Array, Array], tuple[Array, Array, Array]]


def curved_mesh(
    bench: Bench, cells: tuple[int, int], pattern: str, surface: Surface
) -> tuple[dict[str, Any], Array]:
    """The mesh block of cells on a surface of s and t in [0, 1], and its vertices (V, 3) [m]; collective."""
    flat, faces = rectangle(*cells, 1.0, 1.0, alternating=pattern == "alternating")
    vertices = np.column_stack(surface(flat[:, 0], flat[:, 1]))
    return bench.mesh(vertices, faces), vertices


def _curved(
    bench: Bench, n: int, pattern: str, surface: Surface, material: dict[str, Any], **more: Any
) -> Array:
    """Displacements (V, 3) [m] of n × n cells on a surface; collective."""
    mesh, vertices = curved_mesh(bench, (n, n), pattern, surface)
    tight = {"solver": {"force_tolerance": 1e-8}, "petsc": {"ksp_rtol": 1e-8}}
    content = scene(mesh, material, STATIC | {"step": 1.0}, gravity=[0, 0, 0]) | tight | more
    with bench.simulation(content) as trial:
        return trial.run().x - vertices


def cylinder(radius: float, angle: float, length: float) -> Surface:
    """Part of a cylinder with axis y, as a function of s and t in [0, 1]; s = 0 is the crown."""

    def surface(s: Array, t: Array) -> tuple[Array, Array, Array]:
        return radius * np.sin(angle * s), length * t, radius * np.cos(angle * s)

    return surface


def scordelis_lo_roof(bench: Bench, n: float) -> Iterator[Measured]:
    part, half = 1e-3, 25.0  # part of the load, so small that the response is linear to 1e-5
    for pattern in PATTERNS:
        material = {"young": 4.32e8, "poisson": 0.0, "thickness": 0.25, "density": 1.0}
        gravity = [0.0, 0.0, -90.0 * part]
        held = [*symmetric("xy", 25.0), {"box": plane_box("y", half, 25.0), "axes": ["x", "z"]}]
        surface = cylinder(25.0, math.radians(40.0), half)
        u = _curved(bench, round(n), pattern, surface, material, gravity=gravity, handles=held)
        deflection = float(-u[round(n), 2]) / part
        yield Measured(f"deflection, {pattern}", deflection, LINEAR["roof"], "m")
        yield Measured(f"deflection, {pattern}, deep shell", deflection, LINEAR["deep_roof"], "m")


def pinched_cylinder(bench: Bench, n: float) -> Iterator[Measured]:
    force = 100.0
    for pattern in PATTERNS:
        material = {"young": 3e6, "poisson": 0.3, "thickness": 3.0, "density": 1.0}
        loads = [{"nodes": [0], "force": [0.0, 0.0, -force / 4.0]}]
        held = [{"box": plane_box("y", 300.0, 300.0), "axes": ["x", "z"]}, *symmetric("xyz", 300.0)]
        shell = (cylinder(300.0, 0.5 * math.pi, 300.0), material)
        coarse, fine = (
            float(-_curved(bench, cells, pattern, *shell, loads=loads, handles=held)[0, 2]) / force
            for cells in (round(n) // 2, round(n))
        )
        # the order 1.5 of the deflection under a point load, where curvatures are unbounded
        last = fine + (fine - coarse) / (2.0**1.5 - 1.0)
        yield Measured(f"deflection, {pattern}", fine, LINEAR["cylinder"], "m/N")
        yield Measured(f"deflection, {pattern}, extrapolated", last, LINEAR["cylinder"], "m/N")


def open_hemisphere(bench: Bench, n: float) -> Iterator[Measured]:
    part, cells = 0.02, round(n)  # part of the load; quadratic terms cancel in the mean of both loads
    for pattern in PATTERNS:
        material = {"young": 6.825e7, "poisson": 0.3, "thickness": 0.04, "density": 1.0}
        loads = [{"nodes": [0], "force": [part, 0.0, 0.0]}, {"nodes": [cells], "force": [0.0, -part, 0.0]}]
        held = [*symmetric("xy", 10.0), {"nodes": [cells // 2], "axes": ["z"]}]

        def surface(s: Array, t: Array) -> tuple[Array, Array, Array]:
            around, up = 0.5 * math.pi * s, math.radians(72.0) * t
            ring = 10.0 * np.cos(up)
            return ring * np.cos(around), ring * np.sin(around), 10.0 * np.sin(up)

        u = _curved(bench, cells, pattern, surface, material, loads=loads, handles=held)
        mean = 0.5 * float(u[0, 0] - u[cells, 1]) / part
        yield Measured(f"displacement of the loads, {pattern}", mean, LINEAR["hemisphere"], "m")


def hyperbolic_paraboloid(bench: Bench, n: float) -> Iterator[Measured]:
    part, cells = 1e-2, round(n)  # part of the load, for a linear response
    for pattern in PATTERNS:
        material = {"young": 2e11, "poisson": 0.3, "thickness": 1e-3, "density": 1.0}
        gravity = [0.0, 0.0, -8.0 * part]
        held = [{"box": plane_box("x", -0.5, 1.0), "clamp": True}, *symmetric("y", 1.0)]

        def surface(s: Array, t: Array) -> tuple[Array, Array, Array]:
            x, y = s - 0.5, 0.5 * t
            return x, y, x**2 - y**2

        u = _curved(bench, cells, pattern, surface, material, gravity=gravity, handles=held)
        exact = TABLES["hyperbolic_paraboloid"]["deflection"]
        yield Measured(f"deflection, {pattern}", float(-u[cells, 2]) / part, exact, "m")


def twisted_beam(bench: Bench, n: float) -> Iterator[Measured]:
    length, width, force = 12.0, 1.1, 1e-6

    def surface(s: Array, t: Array) -> tuple[Array, Array, Array]:
        turned, beside = 0.5 * math.pi * s, width * (t - 0.5)
        return length * s, beside * np.cos(turned), beside * np.sin(turned)

    along, across = round(n), round(n / 12)
    for pattern in PATTERNS:
        mesh, vertices = curved_mesh(bench, (along, across), pattern, surface)
        end = [along + row * (along + 1) for row in range(across + 1)]
        for name, axis in (("in_plane", 2), ("out_of_plane", 1)):
            content = scene(
                mesh,
                {"young": 2.9e7, "poisson": 0.22, "thickness": 0.0032, "density": 1.0},
                STATIC | {"step": 1.0},
                gravity=[0, 0, 0],
                handles=[{"box": plane_box("x", 0.0, length), "clamp": True}],
                loads=_line_load(end, force * np.eye(3)[axis]),
                solver={"force_tolerance": 1e-6},
            )
            with bench.simulation(content) as trial:
                u = float((trial.run().x - vertices)[end[len(end) // 2], axis])
            quantity = f"displacement {name.replace('_', ' ')}, {pattern}"
            yield Measured(quantity, u, TABLES["twisted_beam"][name], "in")


# -- curved shells, large rotations --------------------------------------------------------------------


def open_cylinder_scene(bench: Bench, n: int, pattern: str) -> tuple[dict[str, Any], Array, int]:
    """An eighth of the cylinder, n cells around; vertices (V, 3), the middle one of its side; collective."""
    radius, half = 4.953, 5.175
    cells = n, round(n * half / (0.5 * math.pi * radius))
    mesh, vertices = curved_mesh(bench, cells, pattern, cylinder(radius, 0.5 * math.pi, half))
    material = {"young": 1.05e7, "poisson": 0.3125, "thickness": 0.094, "density": 1.0}
    loads = [{"nodes": [0], "force": [0.0, 0.0, 1e4]}]
    return scene(mesh, material, handles=symmetric("xyz", radius), loads=loads), vertices, n


def open_cylinder(bench: Bench, n: float) -> Iterator[Measured]:
    for pattern in PATTERNS:
        content, vertices, around = open_cylinder_scene(bench, round(n), pattern)

        def displacements(trial: Trial, vertices: Array = vertices, side: int = around) -> Array:
            u = trial.x - vertices
            return np.array([u[0, 2], -u[side, 0], -u[-1, 0]])

        measure = of_points("ABC", f"displacement of {{}}, worst load of the table, {pattern}", "in")
        yield from worst_of_table(bench, content, "open_cylinder", displacements, measure)[0]


def hinged_roof(bench: Bench, n: float) -> Iterator[Measured]:
    # final deflection at the centre of the roof [mm]
    deflection = 30.0
    radius, half, angle = 2540.0, 254.0, 0.1
    loads, deflections = np.array(TABLES["hinged_roof"]["rows"]).T
    for pattern in PATTERNS:
        mesh, _ = curved_mesh(bench, (round(n), round(n)), pattern, cylinder(radius, angle, half))
        content = scene(
            mesh,
            {"young": 3102.75, "poisson": 0.3, "thickness": 12.7, "density": 1.0},
            handles=[
                *symmetric("xy", radius),
                {"box": plane_box("x", radius * math.sin(angle), radius)},
                {"nodes": [0], "axes": ["z"], "motion": "push", "interpolation": "linear"},
            ],
            motions={"push": [{"time": 0.0}, {"time": 1.0, "translate": [0.0, 0.0, -deflection]}]},
        )
        curve = [(0.0, 0.0)]
        for factor, trial in increments(bench, content, INCREMENT / 3.0):
            push = trial.simulation.energy_balance.handle_forces(4)[3][2]
            curve.append((factor * deflection, -4.0 * push / 3000.0))  # over the largest load [N]
        extent = deflections.max(), loads.max()
        distance = _distance(np.column_stack([deflections, loads]) / extent, np.array(curve) / extent)
        computed = np.interp(deflections, *np.array(curve).T)
        up, down = loads[:16], slice(16, 25)  # before and after snap-through
        yield Measured(f"distance of the table from the curve, {pattern}", 1.0 + float(distance.max()), 1.0)
        yield Measured(f"largest load, {pattern}", float(computed[: len(up)].max()), float(up.max()))
        yield Measured(f"smallest load, {pattern}", float(computed[down].min()), float(loads[down].min()))


def _distance(points: Array, line: Array) -> Array:
    """Distances (n,) of points (n, 2) from a polyline (m, 2)."""
    start, side = line[:-1], np.diff(line, axis=0)
    along = np.sum((points[:, None] - start) * side, axis=2) / np.sum(side**2, axis=1)
    foot = start + np.clip(along, 0.0, 1.0)[:, :, None] * side
    return np.linalg.norm(points[:, None] - foot, axis=2).min(axis=1)
