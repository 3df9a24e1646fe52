"""A scene with one of its numbers changed, at states near that of a simulation, and differences of these.

A derivative by a number p is a finite difference of four scenes at p ± δ and p ± 2 δ. Except for round-off it
is exact for polynomials of degree four.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError
from lyra_petsc.linear.low_rank import LowRank
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.phases import Phases
from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping.edge_solve import EdgeSolve
from lyra_petsc.stepping.energy_balance import EnergyBalance
from lyra_petsc.stepping.problem import Problem, build_problem
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.terms.bending.midedge import MidEdge
from lyra_petsc.terms.bending.midedge_shape import Frames, transported
from lyra_petsc.terms.term import Term

CENTRAL = {-2: 1.0 / 12.0, -1: -2.0 / 3.0, 1: 2.0 / 3.0, 2: -1.0 / 12.0}
FORWARD = {0: -25.0 / 12.0, 1: 4.0, 2: -3.0, 3: 4.0 / 3.0, 4: -0.25}
"""Offsets over δ and weights of a first derivative, exact up to degree four. The one-sided difference is for
numbers at the bound of their range."""


@dataclass(frozen=True)
class SceneParameter:
    """A number of a scene to differentiate by.

    Attributes
    ----------
    key : str
        Its path, as ``Scene.changed`` takes it.
    value : float
    size : float
        Size of its usual changes, > 0, to which δ is relative.
    """

    key: str
    value: float
    size: float


@dataclass
class PerturbedScene:
    """The problem of a scene with one number changed.

    Attributes
    ----------
    change : float
        Change of the number.
    weight : float
        Factor of this scene's quantities in a derivative.
    problem : Problem
    energy_balance : EnergyBalance or None
    jacobian, dense, prescribed_force : array, LowRank or None
        Block rows [kg/s], what else the matrix has, and force (n_owned, 3) [N] by which a semi-implicit step
        is linear.
    edges : EdgeSolve or None
    """

    change: float
    weight: float
    problem: Problem
    energy_balance: EnergyBalance | None = None
    jacobian: Array | None = None
    dense: LowRank | None = None
    prescribed_force: Array | None = None
    edges: EdgeSolve | None = None

    @property
    def equations(self) -> StageEquations:
        """The equations of its problem."""
        return self.problem.equations

    def end_edges(self, v: Array) -> None:
        """End the solve for its edges' unknowns at velocities v (n_owned, 3) [m/s]; collective."""
        assert self.edges is not None
        self.edges.end(self.equations, self.equations.evaluate(v))

    def set_frames(self, frames: Sequence[Frames]) -> None:
        """Set the frames of its directors for the next step."""
        for term, own in zip(edged(self.equations), frames, strict=True):
            term.frames = own

    def use_frames(self, equations: StageEquations, started: Sequence[Frames]) -> None:
        """Set the frames of its directors in the present step.

        They are its own, or those of ``equations`` if these have updated their frames since the ``started``
        ones.
        """
        frozen = equations.directors.frozen_in_step or equations.step.frozen
        frames: dict[Term, Any] = {}
        for term, original, start in zip(edged(self.equations), edged(equations), started, strict=True):
            now = frozen[original]
            frames[term] = term.frames if now.number == start.number else now
        if frames:
            self.equations.refreeze(frames)

    def change_frames(self, equations: StageEquations) -> None:
        """Express its present and past directors in the present frames of ``equations``."""
        own, change, changed = self.equations, np.zeros((self.equations.points.n_owned, 3)), False
        for term, original in zip(edged(own), edged(equations), strict=True):
            indices, ends, length, _ = term.of_edges
            old: Frames = own.step.frozen[term]
            if old.number == original.frames.number:
                continue
            across = own.x[ends[:, 1]] - own.x[ends[:, 0]]
            tangent = across / np.linalg.norm(across, axis=1, keepdims=True)
            first, second = transported(old, tangent), transported(original.frames, tangent)
            sine = np.sum(np.cross(tangent, first) * second, axis=1)
            angle = np.arctan2(sine, np.sum(first * second, axis=1))
            owned = indices < change.size
            change.reshape(-1)[indices[owned]] = -(length * angle)[owned]
            changed = True
        if changed:
            own.x[: len(change)] += change
            own.state.update_ghosts()
            own.integrator.shift_past_positions(change)

    def residual(self, v: Array) -> Array:
        """F (n_owned, 3) [N] at velocities v (n_owned, 3) of the stage, which it prescribes; collective."""
        equations = self.equations
        equations.prescribe(v)
        if self.jacobian is None:
            return equations.residual_at(v)
        start = np.zeros_like(v)
        equations.prescribe(start)
        out = equations.residual_at(start)
        if self.prescribed_force is not None:
            out += self.prescribed_force
        local = equations.points.extended(v - start)
        out += equations.discretisation.rows.product(self.jacobian, local)
        return out if self.dense is None else out + self.dense.product(v - start)


class Tangent:
    """Derivatives of the state of a simulation with respect to one number of its scene.

    Parameters
    ----------
    delta : float
        δ, change of the number.
    perturbed : list of PerturbedScene
    n_owned : int

    Attributes
    ----------
    x, v : (n_owned, 3)
        Derivatives of positions and velocities; at first of those at the start.
    history : dict of (n_owned, 3)
        Those of the integrator's history.
    """

    def __init__(self, delta: float, perturbed: list[PerturbedScene], n_owned: int) -> None:
        self.delta, self.perturbed, self._n = delta, perturbed, n_owned
        self.history: dict[str, Array] = {}
        self._update_state()

    def difference(self, quantity: Callable[[PerturbedScene], Array]) -> Array:
        """Derivative of a quantity of each perturbed scene."""
        return np.asarray(sum(scene.weight * quantity(scene) for scene in self.perturbed))

    def update(self) -> None:
        """Compute the derivatives from the present states of the perturbed scenes."""
        self._update_state()
        names = self.perturbed[0].equations.integrator.saved_state()[0]
        self.history = {name: self.difference(partial(_history_array, name)) for name in names}

    def _update_state(self) -> None:
        self.x = self.difference(lambda scene: scene.equations.x[: self._n])
        self.v = self.difference(lambda scene: scene.equations.v[: self._n])


def _history_array(name: str, scene: PerturbedScene) -> Array:
    """The array ``name`` of the integrator's history."""
    return scene.equations.integrator.saved_state()[0][name]


def edged(equations: StageEquations) -> list[MidEdge]:
    """The terms with directors."""
    return [term for term in equations.active.with_edges if isinstance(term, MidEdge)]


def perturbed_scenes(
    comm: MPI.Comm,
    scene: Scene,
    parameter: SceneParameter,
    delta: float,
    mesh: Mesh | None,
    owner: NDArray[np.int64] | None,
) -> list[PerturbedScene]:
    """The problems of a scene with a number changed by multiples of ``delta``; collective.

    ``mesh`` and ``owner`` are as in `build_problem`.

    Raises
    ------
    InputError
        If neither central nor one-sided differences give valid scenes.
    """
    return [
        PerturbedScene(offset * delta, weight / delta, build_problem(comm, changed, Phases(), mesh, owner))
        for offset, weight, changed in _changed_scenes(scene, parameter, delta)
    ]


def _changed_scenes(
    scene: Scene, parameter: SceneParameter, delta: float
) -> Iterator[tuple[float, float, Scene]]:
    """Offsets over ``delta``, weights and scenes."""

    def changed(weights: Mapping[int, float]) -> list[tuple[float, float, Scene]]:
        return [
            (float(offset), weight, scene.changed({parameter.key: parameter.value + offset * delta}))
            for offset, weight in weights.items()
        ]

    backward = {-offset: -weight for offset, weight in FORWARD.items()}
    problem: InputError | None = None
    for weights in (CENTRAL, FORWARD, backward):
        try:
            yield from changed(weights)
        except InputError as error:
            problem = problem or error
        else:
            return
    assert problem is not None
    raise problem
