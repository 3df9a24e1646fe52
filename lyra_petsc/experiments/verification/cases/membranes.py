"""Membranes: homogeneous deformations, a round membrane under its weight, small vibrations of stretched and
hanging membranes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.experiments.bench import Bench, Trial
from lyra_petsc.experiments.meshes import irregular_rectangle, quarter_disc, rectangle
from lyra_petsc.experiments.verification.flat_plates import lowest_modes
from lyra_petsc.experiments.verification.rods import stretches
from lyra_petsc.experiments.verification.verification_case import (
    ASSEMBLED,
    STATIC,
    G,
    Measured,
    grid,
    isotropic,
    load_data,
    scene,
    worst,
    worst_value,
)

MATERIALS = {
    "isotropic": {"c11": 1e3 / 0.91, "c12": 300.0 / 0.91, "c22": 1e3 / 0.91, "c33": 350.0 / 0.91},
    "orthotropic": {"c11": 1200.0, "c12": 300.0, "c22": 800.0, "c33": 250.0},
    "nu = 0": {"c11": 1000.0, "c12": 0.0, "c22": 1000.0, "c33": 500.0},
}
"""Membrane stiffnesses [N/m]"""

TURN = math.radians(30.0)
GRADIENTS = [
    np.diag(stretches)
    for stretches in ([1, 1], [1.1, 1], [1, 0.9], [1.05, 1.2], [1.2, 1 / 1.2], [3, 1], [0.2, 1])
]
GRADIENTS += [np.array([[1.0, 0.3], [0.0, 1.0]]), np.array([[1.07, 0.11], [-0.05, 0.93]])]
GRADIENTS += [np.array([[math.cos(TURN), -math.sin(TURN)], [math.sin(TURN), math.cos(TURN)]]) @ GRADIENTS[3]]
"""Plane deformation gradients F: stretches, simple shear, a general one, a rotation of stretches."""

BASE, HEIGHT = 1.0, 0.7
"""Sides of the sheet [m]"""

NEAR = 1e-6
"""Distance [m] from an edge within which vertices count as on it"""

TILT = np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))[0]
"""Rotation of the deformed sheet in space, on which no result may depend."""


def _scene(mesh: dict[str, Any], material: str, **more: Any) -> dict[str, Any]:
    shell = {"density": 0.2, "membrane": MATERIALS[material]}
    return scene(mesh, shell, **{"time": ASSEMBLED} | more)


def patch_states(bench: Bench, n: float) -> Sequence[Measured]:
    vertices, triangles = irregular_rectangle(int(n), int(n), BASE, HEIGHT)
    mesh = bench.mesh(vertices, triangles)
    states: list[list[Measured]] = []
    for material in MATERIALS:
        with bench.simulation(_scene(mesh, material)) as trial:
            for gradient in GRADIENTS:
                trial.set_state(x=vertices[:, :2] @ gradient.T @ TILT[:2])
                states.append(_of_state(trial, gradient, MATERIALS[material]))
    return worst(states)


def answer(gradient: Array, c: dict[str, float]) -> tuple[Array, float]:
    """Stress S11, S22, S12 [N/m] and energy [J/m²] of a deformation gradient F (2, 2)."""
    strain = 0.5 * (gradient.T @ gradient - np.eye(2))
    e = np.array([strain[0, 0], strain[1, 1], 2.0 * strain[0, 1]])
    stress = np.array([[c["c11"], c["c12"], 0.0], [c["c12"], c["c22"], 0.0], [0.0, 0.0, c["c33"]]]) @ e
    return stress, 0.5 * float(e @ stress)


def _of_state(trial: Trial, gradient: Array, c: dict[str, float]) -> list[Measured]:
    problem = trial.simulation.problem
    membrane, points = problem.membrane, problem.points
    exact, stored = answer(gradient, c)
    stiffness, area = max(c["c11"], c["c22"]), BASE * HEIGHT
    energy = trial.sum_over_ranks(membrane.energies(problem.equations.x)) / area
    force = np.zeros((points.n_local, 3))
    membrane.add_gradient(problem.equations.x, None, force)
    x, y = trial.start.T[:2]
    inner = (x > NEAR) & (x < BASE - NEAR) & (y > NEAR) & (y < HEIGHT - NEAR)
    residual = np.abs(trial.gather(force)[inner]).max(initial=0.0)
    scale = float(max(stiffness, *np.abs(exact)))
    # force [N] of one triangle of mean size on a vertex
    nodal = scale * float(np.sqrt(area / problem.whole.n_triangles))
    mine = membrane.strain_and_stress(problem.equations.x)[1][: membrane.n_owned]
    stress = np.concatenate(points.comm.allgather(mine))
    measured = [
        Measured("energy per area", energy, stored, "J/m²", max(stiffness, stored)),
        Measured("largest force on an inner vertex", float(residual), 0.0, "N", nodal),
    ]
    for name, values, known in zip(("S11", "S22", "S12"), stress.T, exact.tolist(), strict=True):
        quantity = f"{name} of the triangle farthest off"
        measured.append(Measured(quantity, worst_value(values, known), known, "N/m", scale))
    return measured


def uniaxial_pull(bench: Bench, n: float) -> Iterator[Measured]:
    vertices, triangles = irregular_rectangle(int(n), int(n), BASE, HEIGHT)
    mesh = bench.mesh(vertices, triangles)
    handles = [
        {"box": [[-NEAR, -1, -1], [NEAR, 1, 1]], "axes": ["x"]},
        {"box": [[BASE - NEAR, -1, -1], [BASE + NEAR, 1, 1]], "axes": ["x"], "motion": "pull",
         "interpolation": "linear"},
        {"nodes": [0], "axes": ["y"]},
        {"box": [[-1, -1, -1], [2, 2, 1]], "axes": ["z"]},
    ]  # fmt: skip
    for material, along in itertools.product(MATERIALS, (1.01, 1.1, 1.5, 2.0)):
        if material == "orthotropic" and along == 2.0:
            continue  # it would contract to nothing
        c, strain = MATERIALS[material], 0.5 * (along**2 - 1.0)
        across = math.sqrt(1.0 - 2.0 * c["c12"] / c["c22"] * strain)
        pull = along * (c["c11"] - c["c12"] ** 2 / c["c22"]) * strain
        pulled = [{"time": 0}, {"time": 1, "translate": [(along - 1.0) * BASE, 0, 0]}]
        static = {"handles": handles, "motions": {"pull": pulled}, "time": STATIC}
        with bench.simulation(_scene(mesh, material, **static)) as trial:
            trial.run()
            problem = trial.simulation.problem
            exact = vertices * [along, across, 0.0]
            off = float(np.abs(trial.x - exact).max())
            force = np.zeros((problem.points.n_local, 3))
            problem.membrane.add_gradient(problem.equations.x, None, force)
            end = vertices[:, 0] > BASE - NEAR
            per_width = float(trial.gather(force)[end, 0].sum()) / HEIGHT
        name = f"{material}, stretched by {along:g}"
        yield Measured(f"largest displacement off, {name}", off, 0.0, "m", BASE)
        yield Measured(f"force per width, {name}", per_width, pull, "N/m")


# -- a round membrane ------------------------------------------------------------------------------------

ROUND = load_data("circular_membrane")


def circular_membrane(bench: Bench, n: float) -> Iterator[Measured]:
    # radius [m], membrane stiffness [N/m]
    radius, stiffness = 1.0, 1000.0
    number = np.arange((int(n) + 1) ** 2).reshape(int(n) + 1, int(n) + 1)
    rim = np.unique(np.concatenate([number[-1], number[:, -1]]))
    mesh, symmetry = bench.mesh(*quarter_disc(int(n), radius)), {"x": number[:, 0], "y": number[0]}
    held: list[dict[str, Any]] = [{"nodes": rim.tolist()}]
    held += [{"nodes": nodes.tolist(), "axes": [axis]} for axis, nodes in symmetry.items()]
    for nu, e, exact in ROUND["rows"]:
        material = {"density": e * stiffness / (G * radius), "membrane": isotropic(stiffness, nu)}
        with bench.simulation(scene(mesh, material, gravity=[0, 0, -G], handles=held)) as trial:
            sag = -float(trial.run().x[0, 2])
        name = f"central deflection, ν = {nu:g}, load {e:g} C/a"
        yield Measured(name, sag, exact * radius, "m")


# -- a stretched one -------------------------------------------------------------------------------------

LONG, SHORT, AREAL = 1.0, 0.5, 0.2
"""Sides [m] and density [kg/m²]"""

TENSE = {"c11": 1000.0, "c22": 1000.0, "c12": 300.0, "c33": 350.0}
"""N/m"""

STRETCHES = np.diag([1.02, 1.01])


def omega_of(along: int, across: int) -> float:
    """ω [rad/s] of a mode."""
    (s11, s22, _), _ = answer(STRETCHES, TENSE)
    return math.pi * math.sqrt((s11 * (along / LONG) ** 2 + s22 * (across / SHORT) ** 2) / AREAL)


def _stretched(bench: Bench, n: int, time: dict[str, Any], **more: Any) -> dict[str, Any]:
    """The scene of the stretched membrane with fixed edges; n × n/2 cells."""
    vertices, triangles = rectangle(n, n // 2, LONG, SHORT)
    number = np.arange(len(vertices)).reshape(n // 2 + 1, n + 1)
    edge = np.unique(np.concatenate([number[0], number[-1], number[:, 0], number[:, -1]]))
    start = vertices * [*np.diag(STRETCHES), 0.0]
    mesh = bench.mesh(start, triangles, rest=vertices[:, :2])
    return scene(
        mesh, {"density": AREAL, "membrane": TENSE}, time, handles=[{"nodes": edge.tolist()}], **more
    )


def stretched_membrane(bench: Bench, n: float) -> Iterator[Measured]:
    # numbers of half waves along and across, by ascending frequency
    modes = ((1, 1), (2, 1), (3, 1), (1, 2))
    with bench.simulation(_stretched(bench, int(n), ASSEMBLED)) as trial:
        omegas, _ = lowest_modes(trial, len(modes))
    for mode, omega in zip(modes, omegas, strict=True):
        yield Measured(f"ω of mode {mode[0]}{mode[1]}", float(omega), omega_of(*mode), "rad/s")


PERIOD = 2.0 * math.pi / omega_of(1, 1)
"""s"""


def released_mode(bench: Bench, n: float) -> Iterator[Measured]:
    for integrator in ("beuler", "midpoint", "alpha2", "bdf2"):
        omega, states = _followed(bench, n, integrator)
        turn, dt = -np.unwrap(np.angle(states)), PERIOD / n
        per_step = float(turn[-1] - turn[0]) / (len(states) - 1)
        yield Measured(f"ω, {integrator}", per_step / dt, omega, "rad/s")
        x = omega * dt
        exact = {
            "beuler": (math.atan(x), 1.0 / math.hypot(1.0, x)),
            "midpoint": (2.0 * math.atan(0.5 * x), 1.0),
        }
        if integrator in exact:
            phase, amplification = exact[integrator]
            shrunk = float(abs(states[-1] / states[-2]))
            yield Measured(f"phase of a step, {integrator}", per_step, phase, "rad")
            yield Measured(f"amplification of a step, {integrator}", shrunk, amplification)


def _followed(bench: Bench, n: float, integrator: str) -> tuple[float, NDArray[np.complex128]]:
    """ω of the first mode from K and M, and q + i q̇/ω of its modal coordinate after each step of a period."""
    time = {"end": PERIOD, "step": PERIOD / n, "integrator": integrator}
    # Newton's method must reach round-off: forces of the stretched sheet are large, those of the motion small
    tight = {"force_tolerance": 1e-15, "step_tolerance": 1e-15}
    with bench.simulation(_stretched(bench, 16, time, solver=tight)) as trial:
        frequencies, shapes = lowest_modes(trial, 1)
        omega, shape = float(frequencies[0]), shapes[0]
        # amplitude [m], small enough for a linear motion, large enough for forces above round-off
        trial.set_state(x=trial.start + 1e-5 / np.abs(shape).max() * shape)
        weights = trial.mass[:, None] * shape
        states = []
        for count in range(round(n) + 1):
            if count:
                trial.step()
            q, rate = np.sum(weights * (trial.x - trial.start)), np.sum(weights * trial.v)
            states.append(complex(q, rate / omega))
    return omega, np.array(states)


# -- a hanging one ---------------------------------------------------------------------------------------


def hanging_chain(bench: Bench, n: float) -> Iterator[Measured]:
    # length [m], density [kg/m²], membrane stiffness [N/m], which the weight stretches by 1e-6
    length, density, stiffness = 1.0, 0.2, 1e6
    # heights at which each bar between two rows carries the weight below its middle
    tension = density * G * length * (np.arange(int(n)) + 0.5) / n
    heights = np.append(0.0, np.cumsum(stretches(tension, 1.0 / stiffness)) * length / n)
    # under uniaxial tension neighbouring columns of vertices are not coupled: only the middle one of three is
    # free, whose masses are those of a wide sheet
    kept = {"sheet": "x", "left": "z", "right": "z"}
    held = [{"group": "top"}, *({"group": name, "axes": [axis]} for name, axis in kept.items())]
    mesh, material = grid(0.05, length, 2, int(n)), {"density": density, "membrane": isotropic(stiffness)}
    with bench.simulation(scene(mesh, material, ASSEMBLED, gravity=[0, -G, 0], handles=held)) as trial:
        x = trial.start.copy()
        row = np.rint(x[:, 1] / length * n).astype(np.int64)
        x[:, 1] = length - (heights[-1] - heights)[row]
        trial.set_state(x=x)
        omegas, _ = lowest_modes(trial, 3)
    from scipy.special import jn_zeros

    zeros = 0.5 * jn_zeros(0, len(omegas)) * math.sqrt(G / length)
    for k, (omega, exact) in enumerate(zip(omegas, zeros, strict=True), 1):
        yield Measured(f"ω of mode {k}", float(omega), float(exact), "rad/s")
