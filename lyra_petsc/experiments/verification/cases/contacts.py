"""Contact: sheets at rest, with friction on slopes, on each other and over a cylinder, and colliding."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.experiments.bench import Bench, Trial
from lyra_petsc.experiments.meshes import irregular_rectangle, rectangle
from lyra_petsc.experiments.verification.verification_case import (
    FLOOR,
    STATIC,
    G,
    Measured,
    grid,
    isotropic,
    scene,
    worst,
    worst_value,
)
from lyra_petsc.output.fields import FIELDS
from lyra_petsc.terms.term import Elastic

SLOPES = (5.0, 30.0, 60.0)
SLIDING = (0.99, 0.9, 0.5)
"""Coefficients of friction over the tangent of the slope angle, for sliding."""

STICKS = 1.01
STEP = 0.01
CLEAR, SIDE = 0.94, 0.4
"""Initial distance over the gap, near the equilibrium distance; side of a sheet [m]"""

SETTLED = 1.0
"""Time [s] when a sticking sheet has settled."""


def placed(mesh: dict[str, Any], shift: Sequence[float], degrees: float = 0.0) -> dict[str, Any]:
    """A mesh block that is turned about y, so that its x descends, and then moved [m]."""
    turn = {"axis": [0.0, 1.0, 0.0], "degrees": degrees}
    return mesh | {"transform": {"rotate": turn, "translate": list(shift)}}


def cloth(mesh: Any, contact: dict[str, Any], time: dict[str, Any], **more: Any) -> dict[str, Any]:
    """The scene of a heavy cloth of the library in contact."""
    content = scene(mesh, {"cloth": "gray-interlock"}, time, gravity=[0.0, 0.0, -G], contact=contact)
    return content | more


def slope_of(degrees: float) -> tuple[float, Array, Array]:
    """Angle [rad] of a slope that descends along x, its direction downwards and its normal, (3,)."""
    angle = math.radians(degrees)
    cos, sin = math.cos(angle), math.sin(angle)
    return angle, np.array([cos, 0.0, -sin]), np.array([sin, 0.0, cos])


def sheet_on_slope(
    degrees: float, friction: float, cells: int, end: float, integrator: str = "beuler"
) -> dict[str, Any]:
    """A free sheet on a slope."""
    _, _, normal = slope_of(degrees)
    gap = 0.01
    return cloth(
        placed(grid(SIDE, SIDE, cells, cells, "alternating"), (CLEAR * gap * normal).tolist(), degrees),
        {"gap": gap, "friction": friction, "self": False},
        {"end": end, "step": STEP, "integrator": integrator},
        obstacles={"slope": {"plane": {"point": [0.0, 0.0, 0.0], "normal": normal.tolist()}}},
    )


def _roof(bench: Bench, degrees: float) -> dict[str, Any]:
    """The slope as a triangle mesh that does not match the sheet's; collective."""
    _, down, _ = slope_of(degrees)
    flat, faces = rectangle(23, 5, 14.0, 1.5)
    flat = flat + np.random.default_rng(1).uniform(-0.1, 0.1, flat.shape) * [1.0, 1.0, 0.0]
    return {"mesh": bench.mesh(np.outer(flat[:, 0] - 1.0, down) + (flat - 0.5) * [0.0, 1.0, 0.0], faces)}


def _creep(trial: Trial, down: Array) -> float:
    """Largest displacement [m] of a vertex down a slope after the sheet has settled; collective."""
    settled = trial.run_to(SETTLED).x
    return float(np.abs((trial.run().x - settled) @ down).max())


def incline(bench: Bench, n: float) -> Sequence[Measured]:
    creep, accelerations, friction_error = 0.0, [], 0.0
    end = 1.5  # of the simulation of a sliding sheet
    for degrees, triangles in (*((degrees, False) for degrees in SLOPES), (SLOPES[1], True)):
        angle, down, _ = slope_of(degrees)
        slope = {"obstacles": {"slope": _roof(bench, degrees)}} if triangles else {}
        for integrator in ("beuler", "midpoint") if degrees == SLOPES[0] else ("beuler",):
            sticks = sheet_on_slope(degrees, STICKS * math.tan(angle), round(n), 3.0, integrator)
            with bench.simulation(sticks | slope) as trial:
                creep = max(creep, _creep(trial, down))
        for part in SLIDING[1:2] if triangles else SLIDING:
            friction = part * math.tan(angle)
            with bench.simulation(sheet_on_slope(degrees, friction, round(n), end) | slope) as trial:
                before, weight = trial.run_to(0.5 * end).v, G * float(trial.mass.sum())
                while not trial.simulation.finished:
                    trial.step()
                    along = float(trial.simulation.energy_balance.obstacle_forces(1)[0, :3] @ down)
                    error = abs(along / weight - friction * math.cos(angle))
                    friction_error = max(friction_error, error)
                change = (trial.v - before) @ down
            exact = G * (1.0 - part) * math.sin(angle)
            acceleration = float(change.mean()) / (0.5 * end)
            accelerations.append([Measured("acceleration", acceleration, exact, "m/s²")])
    return [
        Measured("creep", creep, 0.0, "m", scale=1.0),
        *worst(accelerations),
        Measured("friction", friction_error, 0.0, scale=1.0),
    ]


# -- at rest ---------------------------------------------------------------------------------------------

FLOORS: dict[str, tuple[dict[str, Any], float]] = {
    "plane": (FLOOR, 0.0),
    "sphere": ({"sphere": {"center": [0.0, 0.0, -0.25], "radius": 0.25}}, 0.0),
    "box": ({"box": {"min": [-0.18, -0.22, 0.0], "max": [0.18, 0.22, 1.0]}, "inside": True}, 30.0),
}
"""The obstacle on or in which a sheet comes to rest, and the initial tilt of the sheet [°]"""


def rest(bench: Bench, n: float) -> Iterator[Measured]:
    half, gap = 0.5 * SIDE, 1e-3
    flat, faces = irregular_rectangle(round(n), round(n), SIDE, SIDE)
    for label, (floor, tilt) in FLOORS.items():
        middle = half * math.cos(math.radians(tilt))
        shift = [-middle, -half, 0.5 * gap + SIDE * math.sin(math.radians(tilt))]
        content = cloth(
            placed(bench.mesh(flat, faces), shift, tilt),
            {"gap": gap, "friction": 0.3, "self": False},
            {"end": 4.0, "step": 0.1},  # long steps of backward Euler damp the motion
            obstacles={label: floor},
        )
        with bench.simulation(content) as trial:
            force = trial.run().simulation.energy_balance.obstacle_forces(1)[0, :3]
            weight = G * float(trial.mass.sum())
            pressure = trial.gather(FIELDS["contact_pressure"].compute(trial.simulation.problem))
        error = float(np.linalg.norm(force + [0.0, 0.0, weight])) / weight
        yield Measured(f"force on the {label} besides the weight", error, 0.0, scale=1.0)
        if label == "plane":
            exact = weight / SIDE**2
            yield Measured("pressure on the plane", worst_value(pressure, exact), exact, "Pa")


# -- belt over a cylinder --------------------------------------------------------------------------------


WRAPS = {0.5: (0.1, 0.5), 1.0: (0.3,), 1.5: (0.1, 0.5)}
"""μ by the angle of wrap over π"""


def _belt(bench: Bench, angle: float, friction: float, n: int) -> tuple[dict[str, Any], list[list[int]]]:
    """The belt, n cells per quarter of the drum, and the vertices of its slack and tight ends; collective.

    The initial distance of its edges from the drum is the gap.
    """
    # radius of the drum and contact gap [m]
    drum_radius, gap = 0.1, 5e-4
    quarter = 0.5 * math.pi / n
    radius, wrapped, tail = (drum_radius + gap) / math.cos(0.5 * quarter), round(angle / quarter), n // 2
    cells, size = wrapped + 2 * tail, 2.0 * radius * math.sin(0.5 * quarter)
    flat, faces = rectangle(cells, 1, cells * size, size)
    index = np.tile(np.arange(cells + 1.0) - tail, 2)
    on_drum = np.clip(index, 0.0, wrapped)
    cos, sin, beyond = np.cos(on_drum * quarter), np.sin(on_drum * quarter), size * (index - on_drum)
    start = np.column_stack([radius * sin + beyond * cos, flat[:, 1], radius * cos - beyond * sin])
    ends = [[0, cells + 1], [cells, 2 * cells + 1]]
    # load factor at which the belt is stretched by 1 %; later the drum turns by 10°
    pulled = 0.2
    elongation = 0.01 * cells * size
    pull = [elongation * math.cos(angle), 0.0, -elongation * math.sin(angle)]
    axis = [0.0, 1.0, 0.0]
    drum = {
        "capsule": {"from": [0.0, -1.0, 0.0], "to": axis, "radius": drum_radius},
        "motion": [
            {"time": 0.0},
            {"time": pulled},
            {"time": 1.0, "rotate": {"axis": axis, "degrees": -10.0}},
        ],
        "interpolation": "linear",
    }
    content = scene(
        bench.mesh(start, faces, rest=flat[:, :2]),
        {"density": 0.1, "membrane": isotropic(1000.0)},
        STATIC | {"step": 0.04},
        petsc={"ts_adapt_dt_max": 0.04},
        handles=[
            {"nodes": ends[0]},
            {"nodes": ends[1], "motion": "pull", "interpolation": "linear"},
            {"nodes": list(range(len(flat))), "axes": ["y"]},
        ],
        motions={
            "pull": [{"time": 0.0}, {"time": pulled, "translate": pull}, {"time": 1.0, "translate": pull}]
        },
        contact={"gap": gap, "friction": friction, "self": False},
        obstacles={"drum": drum},
    )
    return content, ends


def capstan(bench: Bench, n: float) -> Iterator[Measured]:
    for turns, friction in ((turns, friction) for turns, values in WRAPS.items() for friction in values):
        content, ends = _belt(bench, math.pi * turns, friction, round(n))
        with bench.simulation(content) as trial:
            pull = trial.gather(trial.run().simulation.energy_balance.reaction)[:, ::2]
        slack, tight = (float(np.linalg.norm(pull[end].sum(axis=0))) for end in ends)
        label = f"T2/T1, φ = {turns:g} π, μ = {friction:g}"
        yield Measured(label, tight / slack, math.exp(math.pi * turns * friction))


# -- sheets thrown at each other -------------------------------------------------------------------------


def _thrown(bench: Bench, integrator: str, friction: float, n: float) -> dict[str, float]:
    """Largest violations of balances over all steps of a collision, by name; collective.

    A sheet and a smaller, tilted one above it fly towards each other. Resultant and moment of the contact
    forces of a step are over the sums of their sizes, as are those of friction, whose moments refer to the
    start of the step; changes of momentum and angular momentum over their sizes at the start; the increase of
    the energy over its value at the start.
    """
    # speed [m/s], cells along a side of a sheet, sides [m]
    speed, cells, side, small = 2.0, 8, 0.3, 0.24
    turn = {"axis": [0.3, 1.0, 0.2], "degrees": 50.0}
    upper = {"transform": {"rotate": turn, "translate": [0.05, 0.05, 0.25]}}
    content = cloth(
        [grid(side, side, cells, cells, "alternating"), grid(small, small, cells, cells) | upper],
        {"gap": 0.005, "friction": friction},
        {"end": 0.1, "step": 1.0 / n, "integrator": integrator},
        gravity=[0.0, 0.0, 0.0],
    )
    names = ["resultant", "moment", *(["resultant of friction", "moment of friction"] if friction else [])]
    names += ["angular momentum", "momentum", "energy"]
    largest = np.zeros(len(names))
    with bench.simulation(content) as trial:
        equations, contact = trial.simulation.problem.equations, trial.simulation.problem.terms["contact"]
        assert isinstance(contact, Elastic)
        friction_term = trial.simulation.problem.terms.get("friction", contact)
        assert isinstance(friction_term, Elastic)
        below = (np.arange(len(trial.start)) < (cells + 1) ** 2)[:, None]
        trial.set_state(v=np.where(below, [0.2 * speed, 0.0, speed], [0.0, 0.0, -speed]))
        mass = trial.mass[:, None]

        def momenta() -> Array:
            momentum = mass * trial.v
            return np.stack([momentum, np.cross(trial.x, momentum)])

        def imbalance(term: Elastic, x: Array, points: Array) -> list[float]:
            gradient = np.zeros((equations.points.n_local, 3))
            term.add_gradient(x, equations.step.frozen[term], gradient)
            forces = trial.gather(gradient)
            wrenches = np.stack([forces, np.cross(points, forces)])
            resultant = np.abs(wrenches.sum(axis=1)).max(axis=1)
            return (resultant / np.maximum(np.abs(wrenches).sum(axis=(1, 2)), 1e-300)).tolist()

        first, energy = momenta(), trial.simulation.budget.total
        before, sizes = first.sum(axis=1), np.abs(first).sum(axis=(1, 2))
        while not trial.simulation.finished:
            begin = trial.x
            trial.step()
            x = equations.evaluated.x
            now = imbalance(contact, x, trial.gather(x))
            now += imbalance(friction_term, x, begin) if friction else []
            momentum, angular = np.abs(momenta().sum(axis=1) - before).max(axis=1) / sizes
            now += [angular, momentum, trial.simulation.budget.total / energy - 1.0]
            largest = np.maximum(largest, now)
    return dict(zip(names, largest.tolist(), strict=True))


def collision(bench: Bench, n: float) -> Iterator[Measured]:
    throws = (("beuler", 0.0), ("bdf2", 0.0), ("midpoint", 0.0), ("beuler", 0.3), ("midpoint", 0.3))
    for integrator, friction in throws:
        for name, value in _thrown(bench, integrator, friction, n).items():
            with_friction = ", with friction" if friction and "friction" not in name else ""
            yield Measured(f"{name}, {integrator}{with_friction}", value, 0.0, scale=1.0)


# -- a block of layers -----------------------------------------------------------------------------------

LAYER_GAP = 0.002
"""Gap [m] between sheets"""


def layers(bench: Bench, n: float) -> Iterator[Measured]:
    # number of lower sheets, their side and that of the top sheet [m]
    lower, wide, narrow = 3, 0.4, 0.3
    # cells along a side, different so that vertices do not lie on vertices
    wide_cells, narrow_cells = 6, 5
    # μ between sheets, initial speed of the top sheet [m/s], time for settling before [s]
    friction, push, settle = 0.3, 0.8, 0.4

    def sheet(side: float, cells: int, number: int) -> dict[str, Any]:
        shift = [0.01 * (side < wide), 0.5 * (wide - side), CLEAR * LAYER_GAP * (number + 1)]
        return placed(grid(side, side, cells, cells, "alternating"), shift)

    part = narrow**2 / (narrow**2 + lower * wide**2)
    deceleration = friction * G / (1.0 - part)
    content = cloth(
        [*(sheet(wide, wide_cells, number) for number in range(lower)), sheet(narrow, narrow_cells, lower)],
        {"gap": LAYER_GAP, "friction": friction},
        {"end": settle + 1.4 * push / deceleration, "step": 1.0 / n},
        obstacles={"floor": FLOOR | {"friction": 0.0}},
    )
    with bench.simulation(content) as trial:
        trial.run_to(settle)
        number = np.minimum(np.arange(len(trial.start)) // (wide_cells + 1) ** 2, lower)
        top, mass, before = number == lower, trial.mass, trial.x[:, 0]
        trial.set_state(v=np.where(top[:, None], [push, 0.0, 0.0], 0.0))
        work = trial.simulation.budget.external_work
        moved, v = trial.run().x[:, 0] - before, trial.v[:, 0]
        work -= trial.simulation.budget.external_work
    means = np.bincount(number, mass * v) / np.bincount(number, mass)
    distance = float(np.average(moved[top], weights=mass[top]) - np.average(moved[~top], weights=mass[~top]))
    yield Measured("final velocity", worst_value(means, part * push), part * push, "m/s")
    yield Measured("sliding distance", distance, 0.5 * push**2 / deceleration, "m")
    yield Measured("work of friction", work, 0.5 * float(mass[top].sum()) * push**2 * (1.0 - part), "J")


# -- a sheet on a sheet -----------------------------------------------------------------------------------

SLIDERS = ("beuler", "bdf2", "alpha2", "midpoint")
LEAN = 30.0
"""Slope [°]"""


def _sheet_on_sheet(n: int, friction: float, integrator: str, end: float) -> tuple[dict[str, Any], int]:
    """A sheet of n cells a side on a larger, fixed one with another mesh; number of vertices of that one."""
    cells = round(2.3 * n), round(0.87 * n)
    _, down, normal = slope_of(LEAN)
    bed = 1.6, 0.6  # size of the lower sheet [m]
    shift = 0.1 * down + CLEAR * LAYER_GAP * normal + [0.0, 0.5 * (bed[1] - SIDE), 0.0]
    lower = placed(grid(*bed, *cells, "diagonal"), [0.0, 0.0, 0.0], LEAN)
    upper = placed(grid(SIDE, SIDE, n, n, "alternating"), shift.tolist(), LEAN)
    count = (cells[0] + 1) * (cells[1] + 1)
    return cloth(
        [lower, upper],
        {"gap": LAYER_GAP, "friction": friction},
        {"end": end, "step": STEP, "integrator": integrator},
        handles=[{"nodes": list(range(count))}],
    ), count


def sheets(bench: Bench, n: float) -> Iterator[Measured]:
    angle, down, _ = slope_of(LEAN)
    for integrator in SLIDERS:
        accelerations = []
        for part in SLIDING[1:]:
            content, count = _sheet_on_sheet(round(n), part * math.tan(angle), integrator, 0.5)
            with bench.simulation(content) as trial:
                mass = trial.mass[count:]
                before, begin = trial.run_to(0.2).v[count:] @ down, trial.simulation.time
                change = trial.run().v[count:] @ down - before
            exact = G * (1.0 - part) * math.sin(angle)
            measured = float(mass @ change) / mass.sum() / (0.5 - begin)  # steps may have been cut
            accelerations.append([Measured(f"acceleration, {integrator}", measured, exact, "m/s²")])
        yield from worst(accelerations)
        content, count = _sheet_on_sheet(round(n), STICKS * math.tan(angle), integrator, 2.0 * SETTLED)
        with bench.simulation(content) as trial:
            yield Measured(f"creep, {integrator}", _creep(trial, down), 0.0, "m", scale=1.0)
