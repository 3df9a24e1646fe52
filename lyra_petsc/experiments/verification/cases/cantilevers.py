"""Large deflections of strips: cantilevers with a load at the tip, their weight or a rest curvature;
buckling of columns, at Euler's load and beyond it, and of tall cantilevers.

Strips with hinges are one cell wide; strips with directors on edges have any width and any kind of mesh.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from lyra_petsc.experiments.bench import Bench, Trial
from lyra_petsc.experiments.verification.cases.hinges import expected
from lyra_petsc.experiments.verification.flat_plates import (
    DENSITY,
    KINDS,
    MEMBRANE,
    hinged_strip,
    lowest_squares,
    plate_material,
    strip_mesh,
)
from lyra_petsc.experiments.verification.rods import (
    Cantilever,
    cantilever,
    column_shape,
    heavy_coupled_strip,
    overhang_weight,
    tall_cantilever,
)
from lyra_petsc.experiments.verification.verification_case import (
    ASSEMBLED,
    STATIC,
    G,
    Measured,
    isotropic,
    scene,
)
from lyra_petsc.parallel import on_root

PATTERNS = ("alternating", "criss-cross")
"""Mesh patterns on which bending by hinges is not coupled to twist."""

WIDTHS = {"one cell": 0.0, "0.1 L": 0.1, "0.25 L": 0.25}
"""Widths of strips that bend by directors, over their length; 0: one cell."""

Loads = Mapping[str, Sequence[float]]


@dataclass(frozen=True)
class Strip:
    """A clamped strip of length 1 m with B = 1 N·m, static.

    Attributes
    ----------
    label : str
    width : float
        [m].
    stiffness : float
        Effective B on its mesh [N·m].
    scene : callable (**more) → scene content
        ``more`` are further keys.
    """

    label: str
    width: float
    stiffness: float
    scene: Callable[..., dict[str, Any]]


def hinged(n: float, loads: Loads) -> Iterator[tuple[Strip, float]]:
    """Pairs of a strip of square cells with hinges and a load, for the loads of each pattern."""
    for pattern, values in loads.items():
        hinges = Strip(pattern, 1.0 / n, expected(pattern), partial(hinged_strip, pattern, n))
        yield from ((hinges, load) for load in values)


def directed(bench: Bench, n: float, loads: Loads) -> Iterator[tuple[Strip, float]]:
    """Pairs of a strip with directors and a load, for every kind of mesh and the loads of each width."""
    for kind in KINDS:
        for label, values in loads.items():

            def content(
                length: float = 1.0, kind: str = kind, width: float = WIDTHS[label], **more: Any
            ) -> dict[str, Any]:
                mesh, material = strip_mesh(bench, kind, n, width, length), plate_material(MEMBRANE)
                return scene(mesh, material, handles=[{"group": "left", "clamp": True}]) | more

            directors = Strip(f"{kind}, {label} wide", WIDTHS[label] or 1.0 / n, 1.0, content)
            yield from ((directors, load) for load in values)


def _tip(trial: Trial) -> tuple[float, float]:
    """Reach and drop of the free end over L: mean x and −z of its vertices."""
    start = trial.start[:, 0]
    x, _, z = trial.x[np.isclose(start, start.max(), rtol=1e-9)].mean(axis=0) / start.max()
    return float(x), float(-z)


def _compared(bench: Bench, scene: dict[str, Any], exact: Cantilever, label: str) -> Iterator[Measured]:
    """Drop and reach of the tip; errors are relative to the displacement of the tip."""
    with bench.simulation(scene) as trial:
        reach, drop = _tip(trial.run())
    tip_displacement = float(np.hypot(exact.drop, 1.0 - exact.reach))
    yield Measured(f"drop / L, {label}", drop, exact.drop, scale=tip_displacement)
    yield Measured(f"reach / L, {label}", reach, exact.reach, scale=tip_displacement)


def _tip_loads(bench: Bench, strips: Iterator[tuple[Strip, float]]) -> Iterator[Measured]:
    for strip, load in strips:
        # the scene's force is the total over the width
        force = [{"group": "right", "force": [0, 0, -load * strip.stiffness * strip.width]}]
        exact = cantilever(0.0, tip_load=load, stretch=strip.stiffness / MEMBRANE)
        yield from _compared(bench, strip.scene(loads=force), exact, f"{strip.label}, α = {load:g}")


def tip_load(bench: Bench, n: float) -> Iterator[Measured]:
    """α = P L² / B_effective, P per width."""
    return _tip_loads(bench, hinged(n, dict.fromkeys(PATTERNS, (0.25, 1.0, 4.0, 10.0, 50.0))))


def elastica_tip(bench: Bench, n: float) -> Iterator[Measured]:
    """α = P L²/B for each width, P per width."""
    loads = {"one cell": (1.0, 50.0), "0.1 L": (4.0,), "0.25 L": (10.0,)}
    return _tip_loads(bench, directed(bench, n, loads))


def _weights(bench: Bench, strips: Iterator[tuple[Strip, float]]) -> Iterator[Measured]:
    for strip, weight in strips:
        exact = cantilever(weight, stretch=strip.stiffness / MEMBRANE)
        scene = strip.scene(gravity=[0, 0, -weight * strip.stiffness / DENSITY])
        yield from _compared(bench, scene, exact, f"{strip.label}, Γ = {weight:g}")


def heavy_cantilever(bench: Bench, n: float) -> Iterator[Measured]:
    """Γ = w L³ / B_effective."""
    return _weights(bench, hinged(n, dict.fromkeys(PATTERNS, (0.1, 1.0, 10.0, 100.0, 1e3, 1e4))))


def elastica_weight(bench: Bench, n: float) -> Iterator[Measured]:
    """Γ = w L³/B for each width."""
    weights = {"one cell": (1.0, 1000.0), "0.1 L": (10.0,), "0.25 L": (100.0,)}
    return _weights(bench, directed(bench, n, weights))


# -- rolled up -------------------------------------------------------------------------------------------


def _arc(turns: float) -> Cantilever:
    """Tip of a circular arc of length 1 that starts horizontally and bends downwards."""
    angle = 2.0 * math.pi * turns
    return Cantilever(math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle, angle, angle)


def roll_up(bench: Bench, n: float) -> Iterator[Measured]:
    """Turns are parts of a full circle."""
    turns_of = {"diagonal": (0.25, 1.0), "alternating": (0.25, 0.5), "criss-cross": (0.25, 0.5)}
    for strip, turns in hinged(n, turns_of):
        curved = {"rest_curvature": [-2.0 * math.pi * turns, 0.0, 0.0]}
        # without tension or weight the membrane does not stretch; a softer one needs fewer iterations
        scene = strip.scene(membrane=1e4, material=curved)
        yield from _compared(bench, scene, _arc(turns), f"{strip.label}, {turns:g} of a circle")


def elastica_roll_up(bench: Bench, n: float) -> Iterator[Measured]:
    """f = M L/(2π B) for each width: parts of a full circle."""
    for strip, turns in directed(bench, n, {"one cell": (0.25, 1.0), "0.1 L": (0.5,), "0.25 L": (0.5,)}):
        scene = strip.scene(loads=[{"group": "right", "moment": -2.0 * math.pi * turns}])
        yield from _compared(bench, scene, _arc(turns), f"{strip.label}, f = {turns:g}")


# -- strips that twist -----------------------------------------------------------------------------------


def coiling_strip(bench: Bench, n: float) -> Iterator[Measured]:
    # C L²/B, so high that a strip of width 1/64 hardly bends in its own plane
    stiff = 1e7
    for weight in (0.1, 1.0, 10.0, 100.0):  # w L³ / (0.8 B)
        nominal = 0.8 * weight
        scene = hinged_strip("diagonal", n, stiff, gravity=[0, 0, -nominal / DENSITY])
        with bench.simulation(scene) as trial:
            x, y, z = trial.run().x[[round(n), 2 * round(n) + 1]].mean(axis=0).tolist()
        exact = partial(heavy_coupled_strip, nominal, 1.0 / stiff)
        reach, sideways, drop = on_root(bench.comm, exact)
        size = math.hypot(1.0 - reach, sideways, drop)
        yield Measured(f"drop / L, Γ = {weight:g}", -z, drop, scale=size)
        yield Measured(f"reach / L, Γ = {weight:g}", x, reach, scale=size)
        yield Measured(f"sideways / L, Γ = {weight:g}", y - 0.5 / n, sideways, scale=size)


# -- cantilever test of cloth ----------------------------------------------------------------------------

BENDING_LENGTH, CLOTH_DENSITY = 0.02, 0.15
"""Bending length c [m], density [kg/m²]; the rigidity is w c³ with weight w [N/m²]."""

RIGIDITY = CLOTH_DENSITY * G * BENDING_LENGTH**3


def _overhangs(
    bench: Bench, strips: Iterator[tuple[Strip, float]], cloth: Callable[[Strip, float], dict[str, Any]]
) -> Iterator[Measured]:
    """Angles [°] of the chord from clamp to tip below the horizontal; the standard prescribes 41.5°."""
    for strip, angle in strips:
        with bench.simulation(cloth(strip, BENDING_LENGTH * overhang_weight(angle) ** (1.0 / 3.0))) as trial:
            reach, drop = _tip(trial.run())
        reached = math.degrees(math.atan2(drop, reach))
        yield Measured(f"angle of the chord, {strip.label}, overhang for {angle:g}°", reached, angle, "°")


def cloth_overhang(bench: Bench, n: float) -> Iterator[Measured]:
    def cloth(strip: Strip, overhang: float) -> dict[str, Any]:
        material = {
            "density": CLOTH_DENSITY,
            "membrane": isotropic(MEMBRANE * RIGIDITY / overhang**2),
            # corrects the known effective stiffness of the mesh
            "bending": RIGIDITY / strip.stiffness,
        }
        scene = strip.scene(material=material, gravity=[0, 0, -G])
        scene["mesh"]["grid"] |= {"width": overhang, "height": overhang * strip.width}
        return scene

    return _overhangs(bench, hinged(n, dict.fromkeys(PATTERNS, (7.1, 41.5, 45.0))), cloth)


def elastica_overhang(bench: Bench, n: float) -> Iterator[Measured]:
    def cloth(strip: Strip, overhang: float) -> dict[str, Any]:
        material = plate_material(MEMBRANE * RIGIDITY / overhang**2, RIGIDITY) | {"density": CLOTH_DENSITY}
        return strip.scene(length=overhang, material=material, gravity=[0, 0, -G])

    angles = {"one cell": (7.1, 41.5), "0.1 L": (45.0,), "0.25 L": (41.5,)}
    return _overhangs(bench, directed(bench, n, angles), cloth)


COLUMNS: dict[str, tuple[list[dict[str, Any]], float]] = {
    "pinned": ([{"group": "left"}, {"group": "right"}], math.pi**2),
    "clamped": ([{"group": "left", "clamp": True}, {"group": "right", "clamp": True}], 4.0 * math.pi**2),
    "clamped and free": ([{"group": "left", "clamp": True}], 0.25 * math.pi**2),
}
"""Supports of the ends, and the buckling load P L²/B"""

COLUMN, COLUMN_MEMBRANE = 0.1, 1e7
"""Width over length; C L²/B, so large that the effect of stretch is below 1e-5"""

SHIFT = 100.0
"""Shift [1/s²] of the eigenvalue problem, as large as the lowest square, so that K + shift · M is positive
definite also beyond the critical load"""

IN_PLANE = ["x", "y"]


def critical(lowest: Callable[[float], float], first: float, second: float) -> float:
    """The load at which the lowest squared frequency changes its sign, by the secant method."""
    from scipy.optimize import newton

    return float(newton(lowest, first, x1=second, tol=1e-300, rtol=1e-5))


def column(bench: Bench, n: float) -> Iterator[Measured]:
    for label, (ends, exact) in COLUMNS.items():
        for kind in KINDS:
            held = [{"group": "sheet", "axes": IN_PLANE}, *ends]
            mesh, material = strip_mesh(bench, kind, n, COLUMN), plate_material(COLUMN_MEMBRANE)
            with bench.simulation(scene(mesh, material, ASSEMBLED, handles=held)) as trial:

                def lowest(load: float, trial: Trial = trial) -> float:
                    # P = C (λ − λ³)/2, λ nearly 1
                    trial.set_state(x=trial.start * [1.0 - load / COLUMN_MEMBRANE, 1.0, 1.0])
                    return float(lowest_squares(trial, 1, SHIFT)[0][0])

                # from below and from above
                load = critical(lowest, 0.9 * exact, 1.1 * exact)
            yield Measured(f"P L²/B, {label}, {kind}", load, exact)


# -- beyond the critical load ----------------------------------------------------------------------------


def post_buckling(bench: Bench, n: float) -> Iterator[Measured]:
    # shortenings over the length, in this order: the second is reached from above
    shortenings = (0.4, 0.1)
    for kind in KINDS:
        # C L²/B, as of a thickness of 0.011 L; the effect of stretch is 5e-4
        strip = partial(scene, strip_mesh(bench, kind, n, COLUMN), plate_material(1e5))
        for label in ("pinned", "clamped"):
            frames: list[dict[str, Any]] = [{"time": 0.0}, {"time": 0.1, "translate": [-0.02, 0.0, 0.0]}]
            for at, shortening in zip((0.5, 1.0), shortenings, strict=True):
                frames.append({"time": at, "translate": [-shortening, 0.0, 0.0]})
            left, right = COLUMNS[label][0]
            shortened = strip(
                STATIC | {"step": 0.1},
                handles=[left, right | {"motion": "push", "interpolation": "linear"}],
                motions={"push": frames},
                # transverse load [N/m²] by which the column leaves the straight shape; removed at load factor
                # 0.1
                loads=[{"traction": [0.0, 0.0, 20.0], "until": 0.1}],
            )
            with bench.simulation(shortened) as trial:
                for shortening, _ in zip(shortenings, trial.run_through((0.5, 1.0)), strict=True):
                    load, height = column_shape(shortening=shortening)
                    load *= COLUMNS[label][1] / math.pi**2
                    name = f"{label}, {kind}, shortened by {shortening:g} L"
                    yield Measured(f"P L²/B, {name}", _push(trial), load)
                    yield Measured(f"height / L, {name}", _height(trial), height)
        for label, part in {"below": 0.95, "above": 1.2}.items():
            load = part * math.pi**2
            held = [{"group": "left"}, {"group": "right", "axes": ["y", "z"]}]
            pushed = [{"group": "right", "force": [-load * COLUMN, 0.0, 0.0]}]
            with bench.simulation(strip(handles=held, loads=pushed)) as trial:
                risen = _height(trial.run())
                assert trial.simulation.stability["stable"] is not False
            height = column_shape(load=load)[1] if part > 1.0 else 0.0
            name = f"height / L, pinned, {kind}, {label} the critical load"
            yield Measured(name, risen, height, scale=height or 1.0)


def _push(trial: Trial) -> float:
    """Compressive force per width at the right end."""
    end = trial.start[:, 0] > 1.0 - 1e-9
    return -float(trial.gather(trial.simulation.energy_balance.reaction)[end, 0].sum()) / COLUMN


def _height(trial: Trial) -> float:
    return float(np.abs(trial.x[:, 2]).max())


# -- lateral buckling ------------------------------------------------------------------------------------


def lateral_buckling(bench: Bench, n: float) -> Iterator[Measured]:
    # depths over the length
    for depth in (1.0 / 20.0, 1.0 / 50.0):
        for poisson in (0.0, 0.3):
            bend, twist = (1.0 - poisson**2) * depth, 2.0 * (1.0 - poisson) * depth
            factor, ratio = tall_cantilever(bend / twist, bend * depth**2 / 12.0 / twist)
            unit = math.sqrt(bend * twist)
            for kind in KINDS:
                load, shape = _tipping(bench, kind, n, depth, poisson, factor * unit)
                name = f"L/b = {1.0 / depth:g}, {kind}, ν = {poisson:g}"
                yield Measured(f"P L²/√(EI GJ), {name}", load / unit, factor)
                yield Measured(f"rotation of the tip over deflection / L, {name}", shape, ratio)


def _tipping(
    bench: Bench, kind: str, n: float, depth: float, poisson: float, about: float
) -> tuple[float, float]:
    """Critical load [N], near ``about``, and rotation of the tip over its deflection over L in the mode."""
    # C L²/D, so high that the strip hardly bends in its plane
    strip = partial(scene, strip_mesh(bench, kind, n / depth, depth), plate_material(1e8, poisson=poisson))
    clamp = {"group": "left", "clamp": True}
    # the equilibrium in the plane comes first; buckling needs displacements out of the plane only
    plane = strip(STATIC | {"step": 1.0}, handles=[clamp, {"group": "sheet", "axes": ["z"]}])
    across = strip(ASSEMBLED, handles=[clamp, {"group": "sheet", "axes": IN_PLANE}])
    mode = np.empty(0)

    def lowest(load: float) -> float:
        nonlocal mode
        loads = [{"group": "right", "force": [0.0, load, 0.0]}]
        with bench.simulation(plane | {"loads": loads}) as trial:
            x = trial.run().x
        with bench.simulation(across) as trial:
            trial.set_state(x=x)
            squares, shapes = lowest_squares(trial, 1, SHIFT)
            end = trial.start[:, 0] > 1.0 - 1e-9
            mode = np.stack([trial.start[end, 1], shapes[0][end, 2]])
        return float(squares[0])

    load = critical(lowest, 0.95 * about, 1.05 * about)
    turn, deflection = np.polyfit(mode[0] - 0.5 * depth, mode[1], 1)
    return load, abs(float(turn / deflection))
