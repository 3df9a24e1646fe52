"""Strips of directors on edges that buckle: columns, at Euler's load and beyond it, and tall cantilevers."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.experiments.bench import Bench, Trial
from lyra_petsc.experiments.verification.answers import ASSEMBLED, STATIC, Measured, at_finest, case, scene
from lyra_petsc.experiments.verification.flat_plates import KINDS, plate_material, strip_mesh
from lyra_petsc.experiments.verification.rods import column_shape, tall_cantilever
from lyra_petsc.experiments.verification.spectrum import lowest_squares

Array = NDArray[np.float64]

COLUMNS: dict[str, tuple[list[dict[str, Any]], float]] = {
    "pinned": ([{"group": "left"}, {"group": "right"}], math.pi**2),
    "clamped": ([{"group": "left", "clamp": True}, {"group": "right", "clamp": True}], 4.0 * math.pi**2),
    "clamped and free": ([{"group": "left", "clamp": True}], 0.25 * math.pi**2),
}
"""What holds the ends, and P L²/B at which the column buckles"""

WIDTH, MEMBRANE = 0.1, 1e7
"""Over the length; C L²/B, so large that the stretch counts for less than 1e-5"""

SHIFT = 100.0
"""1/s², of the size of the lowest square: it stays positive with it also beyond the critical load"""

IN_PLANE = ["x", "y"]
SECANTS, CLOSE = 8, 1e-5


def _critical(lowest: Callable[[float], float], first: float, second: float) -> float:
    """The load at which the lowest square changes its sign, by the secant method."""
    low, high = lowest(first), lowest(second)
    for _ in range(SECANTS):
        first, second = second, second - high * (second - first) / (high - low)
        if abs(second - first) <= CLOSE * abs(second):
            break
        low, high = high, lowest(second)
    return second


@case(
    "Columns that bend by directors: load at which the lowest eigenvalue of the compressed column changes "
    "its sign, against Euler's",
    source="L. Euler, De curvis elasticis (1744), closed form",
    resolutions=(10, 20, 40, 80),
    claim=at_finest(2e-3),
    quick=2,
    counts="cells along the column",
)
def column(bench: Bench, n: float) -> Iterator[Measured]:
    for words, (ends, exact) in COLUMNS.items():
        for kind in KINDS:
            held = [{"group": "sheet", "axes": IN_PLANE}, *ends]
            mesh, material = strip_mesh(bench, kind, n, WIDTH), plate_material(MEMBRANE)
            with bench.simulation(scene(mesh, material, ASSEMBLED, handles=held)) as trial:

                def lowest(load: float, trial: Trial = trial) -> float:
                    # P = C (λ − λ³)/2, λ nearly 1
                    trial.set_state(x=trial.start * [1.0 - load / MEMBRANE, 1.0, 1.0])
                    return float(lowest_squares(trial, 1, SHIFT)[0][0])

                # from below and from above
                load = _critical(lowest, 0.9 * exact, 1.1 * exact)
            yield Measured(f"P L²/B, {words}, {kind}", load, exact)


# -- beyond the critical load ----------------------------------------------------------------------------

SHORTENINGS = (0.4, 0.1)
"""Over the length, one after the other: the second is reached from above."""

SOFTER = 1e5
"""C L²/B: as of a thickness of 0.011 L; the stretch counts for 5e-4"""

ASIDE = 20.0
"""N/m²: a load across that makes the column leave the straight shape, and is gone at a tenth of the way"""

LOADS = {"below": 0.95, "above": 1.2}
"""Over the critical load"""


@case(
    "Columns beyond the critical load: force and height when the ends approach each other to 0.6 L and go "
    "back to 0.9 L, and the height under a load below and above the critical one, against the elastica",
    source="elastica: A. E. H. Love, A Treatise on the Mathematical Theory of Elasticity, 4th ed., § 262-263",
    resolutions=(20, 40, 60),
    claim=at_finest(1e-2),
    quick=1,
    counts="cells along the column",
)
def post_buckling(bench: Bench, n: float) -> Iterator[Measured]:
    for kind in KINDS:
        strip = partial(scene, strip_mesh(bench, kind, n, WIDTH), plate_material(SOFTER))
        for words in ("pinned", "clamped"):
            frames: list[dict[str, Any]] = [{"time": 0.0}, {"time": 0.1, "translate": [-0.02, 0.0, 0.0]}]
            for at, each in zip((0.5, 1.0), SHORTENINGS, strict=True):
                frames.append({"time": at, "translate": [-each, 0.0, 0.0]})
            left, right = COLUMNS[words][0]
            shortened = strip(
                STATIC | {"step": 0.1},
                handles=[left, right | {"motion": "push", "interpolation": "linear"}],
                motions={"push": frames},
                loads=[{"traction": [0.0, 0.0, ASIDE], "until": 0.1}],
            )
            shortenings = iter(SHORTENINGS)
            with bench.simulation(shortened) as trial:
                while not trial.simulation.finished:
                    trial.step()
                    if not np.isclose(trial.simulation.time, (0.5, 1.0)).any():
                        continue
                    shortening = next(shortenings)
                    load, height = column_shape(shortening=shortening)
                    load *= COLUMNS[words][1] / math.pi**2
                    name = f"{words}, {kind}, shortened by {shortening:g} L"
                    yield Measured(f"P L²/B, {name}", _push(trial), load)
                    yield Measured(f"height / L, {name}", _height(trial), height)
        for words, part in LOADS.items():
            load = part * math.pi**2
            held = [{"group": "left"}, {"group": "right", "axes": ["y", "z"]}]
            pushed = [{"group": "right", "force": [-load * WIDTH, 0.0, 0.0]}]
            with bench.simulation(strip(handles=held, loads=pushed)) as trial:
                found = _height(trial.run())
                assert trial.simulation.stability["stable"] is not False
            height = column_shape(load=load)[1] if part > 1.0 else 0.0
            yield Measured(
                f"height / L, pinned, {kind}, {words} the critical load", found, height, scale=height or 1.0
            )


def _push(trial: Trial) -> float:
    """Force of the right end on the column, per width, towards it."""
    end = trial.start[:, 0] > 1.0 - 1e-9
    return -float(trial.gather(trial.simulation.ledger.reaction)[end, 0].sum()) / WIDTH


def _height(trial: Trial) -> float:
    return float(np.abs(trial.x[:, 2]).max())


# -- lateral buckling ------------------------------------------------------------------------------------

DEPTHS = (1.0 / 20.0, 1.0 / 50.0)
"""Over the length"""

POISSON = (0.0, 0.3)

STIFF = 1e8
"""C L²/D: a strip so deep hardly bends in its plane"""


@case(
    "Tall cantilever with a load at its tip, in its plane, D and ν of a plate: the load at which the lowest "
    "eigenvalue of the plane state changes its sign, and the mode",
    source=(
        "Prandtl and Michell 1899; S. Timoshenko and J. Gere, Theory of Elastic Stability (1961), 6.3: "
        "P L² = 4.013 √(EI GJ), with EI = (1 − ν²) D b, GJ = 2 (1 − ν) D b; 4.10 and 4.05 at b = L/20 and "
        "L/50 with the warping that the clamp suppresses, EΓ = (1 − ν²) D b³/12 (E. Reissner and M. Stein, "
        "NACA TN 2369, 1951)"
    ),
    resolutions=(2, 4),
    claim=at_finest(1e-2),
    quick=1,
    counts="cells across",
)
def lateral_buckling(bench: Bench, n: float) -> Iterator[Measured]:
    for depth in DEPTHS:
        for poisson in POISSON:
            bend, twist = (1.0 - poisson**2) * depth, 2.0 * (1.0 - poisson) * depth
            factor, ratio = tall_cantilever(bend / twist, bend * depth**2 / 12.0 / twist)
            unit = math.sqrt(bend * twist)
            for kind in KINDS:
                load, shape = _tipping(bench, kind, n, depth, poisson, factor * unit)
                name = f"L/b = {1.0 / depth:g}, {kind}, ν = {poisson:g}"
                yield Measured(f"P L²/√(EI GJ), {name}", load / unit, factor)
                yield Measured(f"turn of the tip over deflection / L, {name}", shape, ratio)


def _tipping(
    bench: Bench, kind: str, n: float, depth: float, poisson: float, about: float
) -> tuple[float, float]:
    """Critical load [N], near ``about``, and of the mode the tip's turn over its deflection over L."""
    strip = partial(scene, strip_mesh(bench, kind, n / depth, depth), plate_material(STIFF, poisson=poisson))
    clamp = {"group": "left", "clamp": True}
    # in the plane the sheet is in equilibrium; to leave it, it need not move in it
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

    load = _critical(lowest, 0.95 * about, 1.05 * about)
    turn, deflection = np.polyfit(mode[0] - 0.5 * depth, mode[1], 1)
    return load, abs(float(turn / deflection))
