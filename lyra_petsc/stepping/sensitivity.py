"""Derivatives of a simulation with respect to numbers of its scene, by the tangent equations.

Every integrator solves G(V; z_n, p) = 0 for the velocities V of a stage, where z_n is the state at the start
of the step: positions, velocities and the integrator's history. The end z_{n+1} is linear in V and z_n::

    ∂G/∂V V' = −(∂G/∂z z_n' + ∂G/∂p)        z_{n+1}' = ∂z_{n+1}/∂V V' + ∂z_{n+1}/∂z_n z_n'

∂G/∂V is the exact Jacobian of the step, which is assembled with its preconditioner (for ``semi-implicit`` the
regularised one, by which V is found). Directional derivatives of G are finite differences of four
*neighbours*: the same discretised scene at p ± δ, p ± 2 δ, with states z_n ± δ z_n', z_n ± 2 δ z_n'.
Except for round-off they are exact for polynomials of degree four in (z, p), as for a St. Venant-Kirchhoff
membrane whose numbers enter linearly. They also differentiate all that a step freezes (damping at x_n,
normals of the wind, loads), accelerations at its start and histories, without code for each. Generalised
conjugate residuals around the linear solve correct its error and terms that the Jacobian lacks (the stiffness
of pressure in statics).

Sources: Michaleris, Tortorelli & Vidal, Int. J. Numer. Meth. Engng 37 (1994) 2471-2499 (tangent operators of
transient problems); Eisenstat, Elman & Schultz, SIAM J. Numer. Anal. 20 (1983) 345-357 (GCR).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError, SolverError
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.phases import Phases
from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping import edge_solve
from lyra_petsc.stepping.edge_solve import EdgeSolve
from lyra_petsc.stepping.energy_balance import EnergyBalance
from lyra_petsc.stepping.integrators.static import Static
from lyra_petsc.stepping.problem import Problem, build_problem
from lyra_petsc.stepping.simulation import SteppedScene, StepReport
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.statics.pseudo_time import MAX_GROWTH
from lyra_petsc.terms.bending.midedge import MidEdge
from lyra_petsc.terms.bending.midedge_shape import Frames, transported
from lyra_petsc.terms.term import Term

CENTRAL = {-2: 1.0 / 12.0, -1: -2.0 / 3.0, 1: 2.0 / 3.0, 2: -1.0 / 12.0}
FORWARD = {0: -25.0 / 12.0, 1: 4.0, 2: -3.0, 3: 4.0 / 3.0, 4: -0.25}
"""Offsets over δ and weights of a first derivative, exact up to degree four. The one-sided difference is for
numbers at the bound of their range."""

DELTA, DELTA_STATIC = 1e-4, 6e-4
"""δ over the size of the number. It is small because damping may change the sign of an eigenvalue between
neighbours. Equilibria have no damping, but are more sensitive to the round-off of forces."""

MAX_CORRECTIONS = 60
"""Largest number of linear solves for one derivative in one step."""

ROUNDOFF_FRACTION = 0.05
"""Residuals below this fraction of the largest possible round-off of forces are not corrected."""

ACCEPTED = 1e-5
"""Residual over the right side that is accepted when corrections end."""


@dataclass(frozen=True)
class Number:
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
class Tangent:
    """Derivatives of positions, velocities (n_owned, 3) and history with respect to one number."""

    x: Array
    v: Array
    history: dict[str, Array] = field(default_factory=dict)


@dataclass
class Neighbour:
    """The scene with one number changed by ``offset`` δ, at a state near that of the simulation."""

    offset: float
    weight: float
    problem: Problem
    energy_balance: EnergyBalance | None = None
    jacobian: Array | None = None
    prescribed_force: Array | None = None
    edges: EdgeSolve | None = None

    def end_edges(self, v: Array) -> None:
        """End the solve for its edges' unknowns at velocities v (n_owned, 3) [m/s]; collective."""
        assert self.edges is not None
        self.edges.end(self.equations, self.equations.evaluate(v))

    @property
    def equations(self) -> StageEquations:
        """The equations of its problem."""
        return self.problem.equations


Neighbours = list[Neighbour]


@dataclass(frozen=True)
class _StepStart:
    """Time, state and history at the start of a step."""

    time: float
    x: Array
    v: Array
    history: dict[str, Array]
    numbers: dict[str, float]
    frames: list[Frames]


@dataclass(frozen=True)
class _Equilibrium:
    """Load factors of the last equilibrium and of this one, and its positions (n_owned, 3) and frames."""

    before: float
    factor: float
    x: Array
    frames: list[Frames]


class Sensitivities:
    """Steps a simulation together with the derivatives of its state; every method is collective.

    Parameters
    ----------
    simulation : SteppedScene
        Not yet stepped, of a scene without contact and without friction.
    numbers : sequence of Number
    mesh : Mesh or None
        The scene's mesh on rank 0, if it is known.
    tolerance : float
        Residual of each step's tangent equations over their right side.
    reactions : bool
        Whether forces of handles are needed.

    Raises
    ------
    InputError
        If a changed number makes no valid scene on any side.
    """

    def __init__(
        self,
        simulation: SteppedScene,
        numbers: Sequence[Number],
        *,
        mesh: Mesh | None = None,
        tolerance: float = 1e-8,
        reactions: bool = False,
    ) -> None:
        self.simulation, self.numbers = simulation, list(numbers)
        self._tolerance = tolerance
        self._equations = simulation.problem.equations
        self._static = isinstance(self._equations.integrator, Static)
        self._semi = self._equations.integrator.lagged_loads and not self._static
        relative = DELTA_STATIC if self._static else DELTA
        self._deltas = [relative * number.size for number in self.numbers]
        self.tangents: list[Tangent] = []
        self._neighbours: list[list[Neighbour]] = []
        owner = self._owner()
        for number, delta in zip(self.numbers, self._deltas, strict=True):
            neighbours = [
                Neighbour(offset, weight, build_problem(simulation.comm, scene, Phases(), mesh, owner))
                for offset, weight, scene in _scenes(simulation.scene, number, delta)
            ]
            self._neighbours.append(neighbours)
            self._begin(neighbours, delta, reactions=reactions)
        if self._equations.points.n_edges_global and not self._static:
            self._solve_initial_edges()

    def destroy(self) -> None:
        """Free the PETSc objects of the neighbours."""
        for neighbours in self._neighbours:
            for neighbour in neighbours:
                neighbour.problem.discretisation.destroy()
        self._neighbours = []

    def _owner(self) -> NDArray[np.int64] | None:
        """Rank of each vertex (V,), on rank 0: partitioners need not give the same result twice."""
        points = self._equations.points
        pieces = points.comm.gather(points.mesh_vertices, root=0)
        if pieces is None:
            return None
        owner = np.empty(points.n_vertices_global, dtype=np.int64)
        for rank, original in enumerate(pieces):
            owner[original] = rank
        return owner

    # -- start -------------------------------------------------------------------------------------

    def _begin(self, neighbours: Neighbours, delta: float, *, reactions: bool) -> None:
        """Compute the derivatives at the start of the simulation."""
        n, points = self._equations.points.n_owned, self._equations.points
        tangent = Tangent(np.zeros((n, 3)), np.zeros((n, 3)))
        for neighbour in neighbours:
            tangent.x += (neighbour.weight / delta) * neighbour.equations.x[:n]
            tangent.v += (neighbour.weight / delta) * neighbour.equations.v[:n]
        tangent.x[points.n_vertices :] = 0.0
        _drop_roundoff(tangent.x, self._equations.x[:n], delta)
        _drop_roundoff(tangent.v, self._equations.v[:n], delta)
        for neighbour in neighbours:
            equations = neighbour.equations
            if self._static:
                equations.take_loads(factor=0.0)
                equations.begin_step(0.0, 0.0)
                if self._equations.load_case.unbalanced is not None:
                    equations.take_loads(unbalanced=-equations.out_of_balance())
            if reactions:
                neighbour.energy_balance = EnergyBalance(equations)
        self.tangents.append(tangent)

    def _solve_initial_edges(self) -> None:
        """Compute the derivatives of the edges' unknowns at the start, where moments are balanced."""
        equations, n = self._equations, self._equations.points.n_owned
        start, vertices = equations.x[:n].copy(), self._equations.points.n_vertices
        frames = [term.frames for term in _edged(equations)]
        edge_solve.initial_moments(equations)
        edges = EdgeSolve.begin(equations, start)
        for tangent, neighbours, delta in zip(self.tangents, self._neighbours, self._deltas, strict=True):
            for each in neighbours:
                change = each.offset * delta
                each.equations.state.set(start + change * tangent.x, equations.v[:n] + change * tangent.v)
                for term, own in zip(_edged(each.equations), frames, strict=True):
                    term.frames = own
                edge_solve.initial_moments(each.equations)
                each.edges = EdgeSolve.begin(each.equations, start + change * tangent.x)
                self._use_frames(each.equations, frames)
        still = np.zeros_like(start)
        with self._solver(still, set_up=True, keep=False) as solve:
            for tangent, neighbours, delta in zip(self.tangents, self._neighbours, self._deltas, strict=True):
                for each, v in self._solve_stages(solve, neighbours, delta, still):
                    each.end_edges(v)
                    self._change_frames(each.equations)
                rates = _difference(neighbours, delta, lambda each: each.equations.x[:n])
                tangent.x[vertices:] = rates[vertices:]
        edges.end(equations, equations.evaluate(still))

    # -- a step ------------------------------------------------------------------------------------

    def step(self) -> StepReport:
        """Take one step of the simulation and of all derivatives.

        Raises
        ------
        SolverError
            If the step fails, or its tangent equations are singular.
        """
        simulation, equations = self.simulation, self._equations
        n = equations.points.n_owned
        history, numbers = equations.integrator.saved_state()
        frames = [term.frames for term in _edged(equations)]
        before = _StepStart(
            simulation.time,
            equations.x[:n].copy(),
            equations.v[:n].copy(),
            dict(history),
            dict(numbers),
            frames,
        )
        report = simulation.step()
        if self._static:
            self._differentiate_equilibrium(before)
        else:
            self._differentiate_step(before, fresh=report.newton_iterations == 0)
        return report

    def _differentiate_step(self, before: _StepStart, *, fresh: bool) -> None:
        equations = self._equations
        velocity, end = equations.stage_velocity.copy(), self.simulation.time
        usual, taken = equations.integrator, self.simulation.last_integrator
        semi = self._semi and taken is usual
        with self._solver(velocity, set_up=not semi, keep=not fresh) as solve:
            for tangent, neighbours, delta in zip(self.tangents, self._neighbours, self._deltas, strict=True):
                for each in neighbours:
                    if taken is not usual:
                        each.equations.integrators.take(type(taken)())
                    self._begin_step(each, before, tangent, delta, end, semi=semi)
                for each, v in self._solve_stages(solve, neighbours, delta, velocity):
                    each.equations.accept(each.equations.evaluate(v))
        if edge_solve.is_needed(equations):
            self._differentiate_edges(before)
        for tangent, neighbours, delta in zip(self.tangents, self._neighbours, self._deltas, strict=True):
            for each in neighbours:
                if each.energy_balance is not None:
                    each.energy_balance.record(before.x + each.offset * delta * tangent.x)
                if taken is not usual:
                    each.equations.follow_step(before.v + each.offset * delta * tangent.v)
            self._update_tangent(tangent, neighbours, delta)
            for each in neighbours:
                each.equations.reference.record_starts(end, each.equations.x)

    def _begin_step(
        self, each: Neighbour, before: _StepStart, tangent: Tangent, delta: float, end: float, *, semi: bool
    ) -> None:
        """Begin the step that the simulation has taken, ``semi``-implicit or not, with a neighbour."""
        equations, change = each.equations, each.offset * delta
        equations.state.set(before.x + change * tangent.x, before.v + change * tangent.v)
        history = {
            name: values + change * tangent.history.get(name, 0.0) for name, values in before.history.items()
        }
        equations.integrator.restore(history, before.numbers)
        for term, frames in zip(_edged(equations), before.frames, strict=True):
            term.frames = frames
            term.initialise(equations.x)
        equations.begin_step(before.time, end)
        self._use_frames(equations, before.frames)
        each.jacobian = None
        if semi:
            start = np.zeros_like(before.x)
            equations.prescribe(start)
            each.jacobian = equations.discretisation.rows.zeros()
            at = equations.linearised(start)
            each.prescribed_force = equations.forces.jacobian(at, 1.0, each.jacobian)

    def _use_frames(self, equations: StageEquations, started: Sequence[Frames]) -> None:
        """Set the frames of a neighbour's directors.

        They are its own, or those of the simulation if it has updated its frames since the ``started`` ones.
        """
        pairs = zip(_edged(equations), _edged(self._equations), started, strict=True)
        frozen = self._equations.directors.frozen_in_step or self._equations.step.frozen
        used = [(mine, frozen[theirs], start) for mine, theirs, start in pairs]
        found: dict[Term, Any] = {mine: mine.frames if now is start else now for mine, now, start in used}
        if found:
            equations.refreeze(found)

    def _solve_stages(
        self, solve: Callable[[Array], Array], neighbours: Neighbours, delta: float, velocity: Array
    ) -> list[tuple[Neighbour, Array]]:
        """Solve for the velocities (n_owned, 3) of the stages of a number's neighbours."""
        change = _difference(neighbours, delta, lambda each: each.equations.step.prescribed.velocity)
        prescribed = np.zeros_like(velocity)
        self._equations.step.prescribed.overwrite(prescribed, change)
        derivative = partial(self._stage_derivative, neighbours, delta, velocity)
        dv = self._solve_affine(solve, derivative, prescribed, delta)
        stages = []
        for each in neighbours:
            each.equations.prescribe(v := velocity + each.offset * delta * dv)
            stages.append((each, v))
        return stages

    def _stage_derivative(self, neighbours: Neighbours, delta: float, velocity: Array, dv: Array) -> Array:
        """Derivative (n_owned, 3) of G if the derivative of the stage's velocities is ``dv``."""

        def residual(each: Neighbour) -> Array:
            equations, v = each.equations, velocity + each.offset * delta * dv
            equations.prescribe(v)
            if each.jacobian is None:
                return equations.residual_at(v)
            start = np.zeros_like(v)
            equations.prescribe(start)
            out = equations.residual_at(start)
            if each.prescribed_force is not None:
                out += each.prescribed_force
            return out + _product(equations, each.jacobian, v - start)

        return self._free(_difference(neighbours, delta, residual))

    def _free(self, values: Array) -> Array:
        return np.where(self._equations.step.prescribed.free, values, 0.0)

    def _update_tangent(self, tangent: Tangent, neighbours: Neighbours, delta: float) -> None:
        """Compute the derivatives of the state from the states of the neighbours."""
        n = self._equations.points.n_owned
        for each in neighbours:
            self._change_frames(each.equations)
        tangent.x = _difference(neighbours, delta, lambda each: each.equations.x[:n])
        tangent.v = _difference(neighbours, delta, lambda each: each.equations.v[:n])
        names = neighbours[0].equations.integrator.saved_state()[0].keys()
        tangent.history = {
            name: _difference(neighbours, delta, partial(_history_array, name)) for name in names
        }

    def _change_frames(self, equations: StageEquations) -> None:
        """Express a neighbour's present and past directors in the present frames of the simulation."""
        change = np.zeros((equations.points.n_owned, 3))
        changed = False
        for term, reference in zip(_edged(equations), _edged(self._equations), strict=True):
            indices, ends, length, _ = term.of_edges
            old: Frames = equations.step.frozen[term]
            new = reference.frames
            if old is new:
                continue
            across = equations.x[ends[:, 1]] - equations.x[ends[:, 0]]
            tangent = across / np.linalg.norm(across, axis=1, keepdims=True)
            first, second = transported(old, tangent), transported(new, tangent)
            sine = np.sum(np.cross(tangent, first) * second, axis=1)
            angle = np.arctan2(sine, np.sum(first * second, axis=1))
            own = indices < 3 * equations.points.n_owned
            change.reshape(-1)[indices[own]] = -(length * angle)[own]
            changed = True
        if changed:
            equations.x[: equations.points.n_owned] += change
            equations.state.update_ghosts()
            equations.integrator.shift_past_positions(change)

    # -- edges whose unknowns are in equilibrium at the end of the step -------------------------------

    def _differentiate_edges(self, before: _StepStart) -> None:
        """Solve for the edges' unknowns at the end of the step of all neighbours."""
        equations, n = self._equations, self._equations.points.n_owned
        edges = EdgeSolve.begin(equations, before.x)
        rates = (equations.x[:n] - before.x) / equations.step.stage.c
        for tangent, neighbours, delta in zip(self.tangents, self._neighbours, self._deltas, strict=True):
            for each in neighbours:
                each.edges = EdgeSolve.begin(each.equations, before.x + each.offset * delta * tangent.x)
                self._use_frames(each.equations, before.frames)
        with self._solver(rates, set_up=True, keep=False) as solve:
            for neighbours, delta in zip(self._neighbours, self._deltas, strict=True):
                for each, v in self._solve_stages(solve, neighbours, delta, rates):
                    each.end_edges(v)
        edges.end(equations, equations.evaluate(rates))

    # -- equilibria --------------------------------------------------------------------------------

    def _differentiate_equilibrium(self, before: _StepStart) -> None:
        equations, n = self._equations, self._equations.points.n_owned
        integrator = equations.integrator
        assert isinstance(integrator, Static)
        now = _Equilibrium(
            before.time,
            self.simulation.time,
            equations.x[:n].copy(),
            [term.frames for term in _edged(equations)],
        )
        pseudo = integrator.pseudo_dt
        integrator.pseudo_dt = math.sqrt(MAX_GROWTH) * self._fall_time()
        equations.begin_step(now.before, now.factor)
        reach = equations.step.stage.c
        with self._solver(np.zeros_like(now.x), set_up=True, keep=False) as solve:
            for tangent, neighbours, delta in zip(self.tangents, self._neighbours, self._deltas, strict=True):
                # sets the goals of handles
                self._force_derivative(now, neighbours, delta, np.zeros_like(now.x))
                prescribed = np.zeros_like(now.x)
                change = _difference(neighbours, delta, lambda each: each.equations.step.prescribed.goal)
                equations.step.prescribed.overwrite(prescribed, change)
                _drop_roundoff(prescribed, now.x, delta)
                forces = partial(self._force_derivative, now, neighbours, delta)
                tangent.x = self._solve_affine(lambda r: reach * solve(r), forces, prescribed, delta)
                self._force_derivative(now, neighbours, delta, tangent.x)
                for each in neighbours:
                    if each.energy_balance is not None:
                        each.equations.evaluate(each.equations.stationary_velocity())
                        each.energy_balance.record(now.x)
                    each.equations.reference.record_starts(now.factor, each.equations.x)
        integrator.pseudo_dt = pseudo
        equations.begin_step(now.before, now.factor)
        equations.evaluate(equations.stationary_velocity())

    def _force_derivative(self, now: _Equilibrium, neighbours: Neighbours, delta: float, dx: Array) -> Array:
        """Derivative (n_owned, 3) [N] of the out-of-balance force if that of the positions is ``dx``."""

        def residual(each: Neighbour) -> Array:
            equations = each.equations
            equations.state.set(now.x + each.offset * delta * dx, np.zeros_like(now.x))
            for term, frames in zip(_edged(equations), now.frames, strict=True):
                term.frames = frames
            equations.take_loads(factor=self._equations.load_case.factor)
            equations.begin_step(now.before, now.factor)
            return -equations.out_of_balance()

        return self._free(_difference(neighbours, delta, residual))

    def _fall_time(self) -> float:
        """Time [s] in which the loads move a sheet of this mass by its size."""
        equations = self._equations
        loads, mass = np.linalg.norm(equations.step.loads.force), equations.mass.sum()
        force, total = equations.points.global_sum(float(loads) ** 2, float(mass))
        return math.sqrt(self.simulation.problem.whole.size * total / math.sqrt(force)) if force else 1.0

    # -- linear equations --------------------------------------------------------------------------

    @contextmanager
    def _solver(self, velocity: Array, *, set_up: bool, keep: bool) -> Iterator[Callable[[Array], Array]]:
        """A context that gives approximate solutions by the Jacobian at the velocities of the stage."""
        stepper, equations = self.simulation.stepper, self._equations
        ksp, linear = stepper.solver.ksp, stepper.solver.linear
        if set_up:
            equations.predicted_stress.forget()
            linear.assemble(equations.linearised(velocity), 0.0, keep=keep, convex=True)
        ksp.setOperators(linear.operator.mat, linear.preconditioner.mat)
        tolerances, guess = ksp.getTolerances(), ksp.getInitialGuessNonzero()
        ksp.setTolerances(rtol=max(0.3 * self._tolerance, 1e-13), atol=0.0, max_it=5000)
        ksp.setInitialGuessNonzero(False)
        right, left = stepper.solver.velocity.duplicate(), stepper.solver.velocity.duplicate()

        def solve(values: Array) -> Array:
            right.setArray(np.ascontiguousarray(values).ravel())
            ksp.solve(right, left)
            found = np.array(left.getArray(readonly=True)).reshape(values.shape)
            return self._free(found)

        try:
            yield solve
        finally:
            right.destroy()
            left.destroy()
            ksp.setTolerances(*tolerances)
            ksp.setInitialGuessNonzero(guess)

    def _dot(self, a: Array, b: Array) -> float:
        return float(self._equations.points.global_sum(float(np.vdot(a, b)))[0])

    def _solve_affine(
        self, solve: Callable[[Array], Array], function: Callable[[Array], Array], start: Array, delta: float
    ) -> Array:
        """Solve an affine ``function`` (n_owned, 3) of an array (n_owned, 3) for zero, from ``start``.

        Corrections end at the round-off of forces over δ = ``delta``.
        """
        solution = start.copy()
        residual = function(solution)
        first = norm = math.sqrt(self._dot(residual, residual))
        roundoff = self.simulation.roundoff / delta
        directions: list[tuple[Array, Array]] = []
        for _ in range(MAX_CORRECTIONS):
            if norm <= max(self._tolerance * first, ROUNDOFF_FRACTION * roundoff):
                return solution
            direction = solve(-residual)
            image = function(solution + direction) - residual
            for earlier, earlier_image in directions:
                factor = self._dot(image, earlier_image)
                direction, image = direction - factor * earlier, image - factor * earlier_image
            size = math.sqrt(self._dot(image, image))
            if not (math.isfinite(size) and size > 0.0):
                break
            direction, image = direction / size, image / size
            directions.append((direction, image))
            factor = self._dot(image, residual)
            solution, residual, before = solution - factor * direction, residual - factor * image, norm
            norm = math.sqrt(self._dot(residual, residual))
            if norm > 0.5 * before and norm <= roundoff:
                return solution
        if norm <= max(ACCEPTED * first, roundoff):
            return solution
        raise SolverError(
            f"the tangent equations are not solved at {self.simulation.time:g}: their residual stays at "
            f"{norm / first:.2g} of their right side; the state is near a bifurcation, or not converged: "
            "give smaller steps, or a smaller solver.force_tolerance",
            collective=True,
        )

    # -- results -----------------------------------------------------------------------------------

    def derivatives(self, quantity: Callable[[Problem, EnergyBalance | None], Array]) -> Array:
        """Derivatives (m, n) of a quantity (m,) of the present state with respect to the n numbers.

        Parameters
        ----------
        quantity : callable
            Takes a problem at its state, and its energy balance if reactions are needed; collective.
        """
        n, columns = self._equations.points.n_owned, []
        for tangent, neighbours, delta in zip(self.tangents, self._neighbours, self._deltas, strict=True):

            def value(each: Neighbour, tangent: Tangent = tangent, delta: float = delta) -> Array:
                change, equations = each.offset * delta, each.equations
                equations.state.set(
                    self._equations.x[:n] + change * tangent.x, self._equations.v[:n] + change * tangent.v
                )
                return np.asarray(quantity(each.problem, each.energy_balance))

            columns.append(_difference(neighbours, delta, value))
        return np.stack(columns, axis=1)


def _difference(neighbours: Neighbours, delta: float, of: Callable[[Neighbour], Array]) -> Array:
    """Finite difference of a quantity ``of`` each neighbour."""
    total: Array | float = 0.0
    for each in neighbours:
        total = total + (each.weight / delta) * of(each)
    return np.asarray(total)


def _history_array(name: str, each: Neighbour) -> Array:
    """The array ``name`` of the integrator's history."""
    return each.equations.integrator.saved_state()[0][name]


def _drop_roundoff(values: Array, base: Array, delta: float) -> None:
    """Set derivatives to 0 that are round-off only, of values that do not depend on the number."""
    values[np.abs(values) * delta <= 1e-14 * (1.0 + np.abs(base))] = 0.0


def _edged(equations: StageEquations) -> list[MidEdge]:
    return [term for term in equations.active.with_edges if isinstance(term, MidEdge)]


def _product(equations: StageEquations, values: Array, v: Array) -> Array:
    """Block rows times v (n_owned, 3); collective."""
    rows, points = equations.discretisation.rows, equations.points
    local = np.zeros((points.n_local, 3))
    local[: len(v)] = v
    points.update_ghosts(local)
    return rows.product(values, local)


def _scenes(scene: Scene, number: Number, delta: float) -> Iterator[tuple[float, float, Scene]]:
    """Offsets, weights and scenes of a number's neighbours.

    Raises
    ------
    InputError
        If neither central nor one-sided differences give valid scenes.
    """

    def changed(weights: Mapping[int, float]) -> list[tuple[float, float, Scene]]:
        return [
            (float(offset), weight, scene.changed({number.key: number.value + offset * delta}))
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
