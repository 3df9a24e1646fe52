"""Exact motions by name: positions and energies at any time.

A sheet falls as a rigid body, freely, level in still air or edge-on in still air. With lumped masses (a third
of the mass of a triangle at each corner) and nodal wind forces (a third of the force at each corner), gravity
and drag of a uniform flat sheet give all vertices the same acceleration on any mesh. The sheet stays
undeformed, and the motion solves the equations discretised in space exactly.

One equilateral triangle oscillates uniformly in its plane, with large amplitude and in closed form. With
circumradius R, areal density ρ and c11 = c22, a triangle that starts with the stretch λ₀ in all directions
stays equilateral; the strain is (λ² − 1)/2 in every direction, the energy A (c11 + c12)(λ² − 1)²/4, the
kinetic energy ρ A R² λ'²/2 with lumped masses, hence (Duffing)::

    λ'' = −k (λ³ − λ),   k = (c11 + c12) / (ρ R²)
    λ = a dn(a √(k/2) t, m),   m = 2 − 2/a²,   a the largest stretch, 1 < a < √2

(dn: Jacobi's elliptic function; DLMF 22.13.15). A triangle that is released at its smallest stretch starts
half a period later.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError, suggest
from lyra_petsc.mesh.build import build_scene_mesh
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.scene.materials.library import resolve_material
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.time_curve import acts, largest
from lyra_petsc.terms.registry import needed_terms
from lyra_petsc.terms.rest import RestShape


@dataclass(frozen=True)
class Energies:
    """Energies [J] at one time, as in ``history.csv``."""

    kinetic: float
    membrane: float
    potential: float


class ExactMotion(ABC):
    """A motion that is an affine map of the start positions, so that it also maps means of vertices."""

    @abstractmethod
    def positions(self, start: Array, t: float) -> Array:
        """Positions (n, 3) [m] at t [s] of points that start at ``start`` (n, 3) [m]."""

    @abstractmethod
    def energies(self, t: float) -> Energies:
        """Energies of the whole scene at t [s]."""


@dataclass(frozen=True, eq=False)
class Translation(ExactMotion):
    """A translation under uniform gravity.

    Attributes
    ----------
    mass : float [kg]
    gravity : (3,) [m/s²]
    potential : float [J]
        −Σ m g·x at t = 0.
    path : callable t [s] → displacement (3,) [m], velocity (3,) [m/s]
    """

    mass: float
    gravity: Array
    potential: float
    path: Callable[[float], tuple[Array, Array]]

    def positions(self, start: Array, t: float) -> Array:
        """Start positions plus the displacement."""
        return np.asarray(start + self.path(t)[0])

    def energies(self, t: float) -> Energies:
        """½ m v² and the potential of gravity."""
        displacement, v = self.path(t)
        fallen = float(np.dot(self.gravity, displacement))
        return Energies(0.5 * self.mass * float(v @ v), 0.0, self.potential - self.mass * fallen)


SAME = 1e-9
"""Relative difference within which lengths and directions count as equal."""


class Body:
    """Mesh, materials and masses of a scene, and properties that exact solutions assume.

    The mesh is made when it is first needed, which raises InputError if it cannot be simulated.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    @cached_property
    def mesh(self) -> Mesh:
        """The mesh of the scene."""
        return build_scene_mesh(self.scene)

    @cached_property
    def rest(self) -> RestShape:
        """The rest shape with its materials."""
        return RestShape(self.scene, self.mesh)

    @property
    def gravity(self) -> Array:
        """Gravity (3,) [m/s²]; zero if the scene has none."""
        return np.zeros(3) + largest(self.scene.gravity)

    @property
    def start_velocity(self) -> Array:
        """Velocity (3,) [m/s] of the translation at t = 0."""
        initial = self.scene.initial
        return np.asarray((0.0, 0.0, 0.0) if initial is None else initial.velocity, dtype=np.float64)

    @cached_property
    def stretch(self) -> Array:
        """Start length over rest length of the sides of all triangles, (F, 3)."""
        corners, flat = self.mesh.positions[self.mesh.triangles], self.mesh.triangle_uv
        start = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
        rest = np.linalg.norm(flat - np.roll(flat, -1, axis=1), axis=2)
        return np.asarray(start / rest)

    @property
    def is_bent(self) -> bool:
        """Whether some interior edge that resists bending does not start at its rest angle."""
        from lyra_petsc.terms.bending import hinge

        for model in {shell.model for shell in self.rest.shells if shell.bends_with(shell.model)}:
            hinges = hinge.elements(self.rest, model)
            angles = hinge.dihedral_angles(self.mesh.positions, hinges.stencil)
            if np.abs(angles - hinges.data["rest_angle"]).max(initial=0.0) > 1e-7:
                return True
        return False

    # -- assumptions shared by solutions -----------------------------------------------------------------

    def influences(self, accounted: Iterable[str]) -> list[str]:
        """Names of all that acts on the sheet, but for initial velocity and the ``accounted`` terms.

        Needs no mesh.
        """
        scene, initial = self.scene, self.scene.initial
        shells = [resolve_material(block, file=scene.source)[0] for block in scene.material]
        terms = (entry.name for entry in needed_terms(scene, shells))
        conditions = {
            "a static analysis": scene.time.static,
            "handles": scene.handles,
            "initial.noise": initial is not None and initial.noise > 0.0,
            "initial.angular_velocity": initial is not None and any(initial.angular_velocity),
        }
        return [*_holding(conditions), *(name for name in terms if name not in accounted)]

    def strained(self) -> list[str]:
        """Reasons why the start shape is not free of stress."""
        stretched = np.abs(self.stretch - 1.0).max() > SAME
        bent = {"a start shape that is bent, or a rest curvature": self.is_bent}
        return _holding({"a start shape that is stretched": stretched} | bent)


@dataclass(frozen=True)
class Solution:
    """An exact solution.

    Attributes
    ----------
    name : str
    title : str
        Description for reports.
    terms : frozenset of str
        Terms of the registry that the solution accounts for; it does not hold where another one acts.
    assumptions : callable
        Properties of a scene, on which no other term acts, that contradict the solution.
    motion : callable
        The motion, for a scene without violations.
    """

    name: str
    title: str
    terms: frozenset[str]
    assumptions: Callable[[Body], list[str]]
    motion: Callable[[Body], ExactMotion]

    def violations(self, body: Body) -> list[str]:
        """What contradicts the solution: all that it does not account for, or else properties."""
        return body.influences(self.terms) or self.assumptions(body)


RIGID = frozenset({"membrane", "bending", "midedge", "midedge_friction", "shear_friction", "gravity"})
"""Terms without force in the translation of a sheet free of stress, and gravity."""


def _translation(body: Body, path: Callable[[float], tuple[Array, Array]]) -> ExactMotion:
    mass, gravity = body.rest.mass, body.gravity
    potential = -float(mass @ (body.mesh.positions @ gravity))
    return Translation(float(mass.sum()), gravity, potential, path)


def _holding(conditions: Mapping[str, object]) -> list[str]:
    """The names of the conditions that hold."""
    return [name for name, holds in conditions.items() if holds]


def free_fall(body: Body) -> ExactMotion:
    """A sheet that moves freely without deformation: x = X + v₀ t + g t²/2."""
    return _translation(body, partial(_free_path, body.start_velocity, body.gravity))


def _free_path(start: Array, g: Array, t: float) -> tuple[Array, Array]:
    return start * t + 0.5 * g * t * t, start + g * t


def _in_still_air(body: Body, drag: str, cosine: float, otherwise: str) -> list[str]:
    """Violations of a fall through still air.

    ``drag`` is the key of the wind that causes its drag, ``cosine`` that of the angle between the sheet's
    normal and gravity, ``otherwise`` what is said of sheets with another one.
    """
    wind, densities, g = body.scene.wind, body.rest.per_triangle("density"), body.gravity
    air = {
        "no gravity": not g.any(),
        "initial.velocity": body.start_velocity.any(),
        "no air (wind with velocity [0, 0, 0])": wind is None,
        "wind that is not still": wind is not None and acts(wind.velocity),
        f"wind.{drag} 0": wind is not None and getattr(wind, drag) == 0.0,
        "materials of different densities": np.ptp(densities) > SAME * densities.max(),
    }
    corners = body.mesh.positions[body.mesh.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    along = np.abs(normals @ g) - cosine * np.linalg.norm(normals, axis=1) * np.linalg.norm(g)
    turned = np.abs(along).max() > SAME * np.linalg.norm(normals, axis=1).max() * np.linalg.norm(g)
    return [*_holding(air), *body.strained(), *_holding({otherwise: turned})]


def _weight_to_drag(body: Body, drag: str) -> float:
    """Weight per area of the sheet over its drag coefficient."""
    density = float(body.rest.per_triangle("density")[0])
    return density * float(np.linalg.norm(body.gravity)) / float(getattr(body.scene.wind, drag))


Law = Callable[[float, float, float], tuple[float, float]]
"""Depth [m] and speed [m/s] by terminal speed [m/s], gravity [m/s²] and time [s]"""


def _fall(law: Law, terminal: float, gravity: Array, t: float) -> tuple[Array, Array]:
    g = math.hypot(*gravity)
    depth, speed = law(terminal, g, t)
    return depth / g * gravity, speed / g * gravity


def _level_law(terminal: float, g: float, t: float) -> tuple[float, float]:
    a = g * t / terminal
    # ln cosh a without overflow
    depth = terminal**2 / g * (a + math.log1p(math.exp(-2.0 * a)) - math.log(2.0))
    return depth, terminal * math.tanh(a)


def flat_fall(body: Body) -> ExactMotion:
    """A level sheet released at rest: v = vt tanh(g t / vt), vt = √(ρ_sheet g / ρ_air).

    Drag grows with the square of the velocity.
    """
    terminal = math.sqrt(_weight_to_drag(body, "density"))
    return _translation(body, partial(_fall, _level_law, terminal, body.gravity))


def _edge_law(terminal: float, g: float, t: float) -> tuple[float, float]:
    part = -math.expm1(-g * t / terminal)
    return terminal * (t - terminal / g * part), terminal * part


def edge_fall(body: Body) -> ExactMotion:
    """An upright flat sheet released at rest: v = vt (1 − exp(−g t / vt)), vt = ρ_sheet g / drag.

    Drag grows with the velocity.
    """
    return _translation(body, partial(_fall, _edge_law, _weight_to_drag(body, "drag"), body.gravity))


@dataclass(frozen=True)
class _Breathing(ExactMotion):
    """The oscillation of a triangle, see the module.

    Attributes
    ----------
    centre : (3,) [m]
    first, largest : float
        Stretch at t = 0, and largest stretch.
    rate : float [1/s²]
        k.
    stiffness : float [J]
        A (c11 + c12).
    """

    centre: tuple[float, float, float]
    first: float
    largest: float
    rate: float
    stiffness: float

    def stretch(self, t: float) -> float:
        """λ at t [s]."""
        from scipy.special import ellipj, ellipk

        m = 2.0 - 2.0 / self.largest**2
        begin = 0.0 if self.first >= 1.0 else float(ellipk(m))
        return self.largest * float(ellipj(self.largest * math.sqrt(0.5 * self.rate) * t + begin, m)[2])

    def positions(self, start: Array, t: float) -> Array:
        """Start positions, scaled about the centre."""
        centre = np.asarray(self.centre)
        return np.asarray(centre + (start - centre) * (self.stretch(t) / self.first))

    def energies(self, t: float) -> Energies:
        """Energies; the kinetic one from conservation."""
        whole = 0.25 * self.stiffness * (self.first**2 - 1.0) ** 2
        membrane = 0.25 * self.stiffness * (self.stretch(t) ** 2 - 1.0) ** 2
        return Energies(whole - membrane, membrane, 0.0)


def breathing_violations(body: Body) -> list[str]:
    """Properties of a scene that contradict a breathing triangle."""
    if body.mesh.n_triangles != 1:
        return [f"{body.mesh.n_triangles} triangles instead of one"]
    shell = body.rest.shells[int(body.rest.shell_of[0])]
    corners, stretch = body.mesh.triangle_uv[0], body.stretch[0]
    sides = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1)
    uneven = np.ptp(stretch) > SAME * stretch.max()
    open_ended = not 0.0 < stretch[0] < math.sqrt(2.0) or abs(stretch[0] - 1.0) < SAME
    contradictions = {
        "a membrane law other than stvk": shell.law != "stvk",
        "initial.velocity": body.start_velocity.any(),
        "c11 and c22 that differ": abs(shell.c11 - shell.c22) > SAME * shell.c11,
        "damping": shell.damping > 0.0,
        "a triangle that is not equilateral": np.ptp(sides) > SAME * sides.max(),
        "a start that is not stretched alike in all directions": uneven,
        "a start stretched by a factor that is 1, or √2 or more": open_ended and not uneven,
    }
    return _holding(contradictions)


def breathing(body: Body) -> ExactMotion:
    """The oscillation of the triangle."""
    shell = body.rest.shells[int(body.rest.shell_of[0])]
    first = float(body.stretch[0].mean())
    radius2 = float(((body.mesh.triangle_uv[0] - body.mesh.triangle_uv[0].mean(axis=0)) ** 2).sum() / 3.0)
    area = float(body.rest.area[0])
    centre = body.mesh.positions.mean(axis=0)
    return _Breathing(
        centre=(float(centre[0]), float(centre[1]), float(centre[2])),
        first=first,
        largest=first if first > 1.0 else math.sqrt(2.0 - first**2),
        rate=(shell.c11 + shell.c12) / (shell.density * radius2),
        stiffness=area * (shell.c11 + shell.c12),
    )


_ALL = (
    Solution("free-fall", "free fall, x = X + v t + g t²/2", RIGID, Body.strained, free_fall),
    Solution(
        "terminal-fall",
        "level sheet falling in still air, v = vt tanh(g t/vt)",
        RIGID | {"wind"},
        partial(_in_still_air, drag="density", cosine=1.0, otherwise="a sheet that is not flat and level"),
        flat_fall,
    ),
    Solution(
        "edge-fall",
        "upright sheet falling edge-on in still air, v = vt (1 - exp(-g t/vt))",
        RIGID | {"wind"},
        partial(_in_still_air, drag="drag", cosine=0.0, otherwise="a sheet that is not upright"),
        edge_fall,
    ),
    Solution(
        "breathing-triangle",
        "equilateral triangle oscillating in its plane, Jacobi's dn",
        frozenset({"membrane", "bending", "midedge"}),
        breathing_violations,
        breathing,
    ),
)
SOLUTIONS = {solution.name: solution for solution in _ALL}
"""Exact solutions by name."""


def exact_motion(name: str, body: Body) -> ExactMotion:
    """The exact motion of that name for a scene.

    Raises
    ------
    InputError
        Unknown name, or a scene to which the solution does not apply; the message says why.
    """
    key = f"--reference exact:{name}"
    if name not in SOLUTIONS:
        raise InputError(f"no exact solution of that name, {suggest(name, SOLUTIONS)}", key=key)
    violations = SOLUTIONS[name].violations(body)
    if violations:
        raise InputError(
            f"does not hold for this scene, which has {', '.join(violations)}",
            file=body.scene.source,
            key=key,
        )
    return SOLUTIONS[name].motion(body)


def matching(body: Body) -> Solution | None:
    """The exact solution that holds for a scene, if one does."""
    return next((solution for solution in SOLUTIONS.values() if not solution.violations(body)), None)
