"""Derivatives of a simulation with respect to numbers of its scene, by the tangent equations.

Every integrator solves G(V; z_n, p) = 0 for the velocities V of a stage, where z_n is the state at the start
of the step: positions, velocities and the integrator's history. The end z_{n+1} is linear in V and z_n::

    ∂G/∂V V' = −(∂G/∂z z_n' + ∂G/∂p)        z_{n+1}' = ∂z_{n+1}/∂V V' + ∂z_{n+1}/∂z_n z_n'

∂G/∂V is the exact Jacobian of the step, which is assembled with its preconditioner (for ``semi-implicit`` the
regularised one, by which V is found). Directional derivatives of G are differences of `perturbed_scenes` with
states z_n ± δ z_n', z_n ± 2 δ z_n': exact but for round-off for a St. Venant-Kirchhoff membrane whose numbers
enter linearly. They also differentiate all that a step freezes (damping at x_n, normals of the wind, loads),
accelerations at its start and histories, without code for each. Generalised conjugate residuals around the
linear solve correct its error and terms that the Jacobian lacks (the stiffness of pressure in statics).

Source: Michaleris, Tortorelli & Vidal, Int. J. Numer. Meth. Engng 37 (1994) 2471-2499 (tangent operators of
transient problems).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.errors import SolverError
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.stepping import edge_solve
from lyra_petsc.stepping.affine_solve import solve_affine
from lyra_petsc.stepping.edge_solve import EdgeSolve
from lyra_petsc.stepping.energy_balance import EnergyBalance
from lyra_petsc.stepping.integrators.static import Static
from lyra_petsc.stepping.perturbed_scenes import (
    PerturbedScene,
    SceneParameter,
    Tangent,
    edged,
    perturbed_scenes,
)
from lyra_petsc.stepping.problem import Problem
from lyra_petsc.stepping.simulation import SteppedScene, StepReport
from lyra_petsc.stepping.statics.equilibrium import start_force
from lyra_petsc.stepping.statics.pseudo_time import MAX_GROWTH
from lyra_petsc.terms.bending.midedge_shape import Frames

DELTA, DELTA_STATIC = 1e-4, 6e-4
"""δ over the size of the number. It is small because damping may change the sign of an eigenvalue between
perturbed scenes. Equilibria have no damping, but are more sensitive to the round-off of forces."""


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
    parameters : sequence of SceneParameter
    mesh : Mesh or None
        The scene's mesh on rank 0, if it is known.
    tolerance : float
        Residual of each step's tangent equations over their right side.
    reactions : bool
        Whether forces of handles are needed.

    Attributes
    ----------
    tangents : list of Tangent
        Derivatives of the present state by each parameter.

    Raises
    ------
    InputError
        If a changed parameter makes no valid scene on any side.
    """

    def __init__(
        self,
        simulation: SteppedScene,
        parameters: Sequence[SceneParameter],
        *,
        mesh: Mesh | None = None,
        tolerance: float = 1e-8,
        reactions: bool = False,
    ) -> None:
        self.simulation, self._tolerance = simulation, tolerance
        self._equations = equations = simulation.problem.equations
        self._static = isinstance(equations.integrator, Static)
        self._semi = equations.integrator.lagged_loads and not self._static
        relative, owner = DELTA_STATIC if self._static else DELTA, self._owner()
        self.tangents: list[Tangent] = []
        for parameter in parameters:
            delta = relative * parameter.size
            scenes = perturbed_scenes(simulation.comm, simulation.scene, parameter, delta, mesh, owner)
            self.tangents.append(Tangent(delta, scenes, equations.points.n_owned))
            self._begin(self.tangents[-1], reactions=reactions)
        if equations.points.n_edges_global and not self._static:
            self._solve_initial_edges()

    def destroy(self) -> None:
        """Free the PETSc objects of the perturbed scenes."""
        for tangent in self.tangents:
            for scene in tangent.perturbed:
                scene.problem.discretisation.destroy()
            tangent.perturbed.clear()

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

    def _begin(self, tangent: Tangent, *, reactions: bool) -> None:
        """Set the derivatives and the perturbed scenes at the start of the simulation."""
        n, points = self._equations.points.n_owned, self._equations.points
        tangent.x[points.n_vertices :] = 0.0
        _drop_roundoff(tangent.x, self._equations.x[:n], tangent.delta)
        _drop_roundoff(tangent.v, self._equations.v[:n], tangent.delta)
        for scene in tangent.perturbed:
            equations = scene.equations
            if self._static:
                force = start_force(equations)
                if self._equations.load_case.unbalanced is not None:
                    equations.take_loads(unbalanced=-force)
            if reactions:
                scene.energy_balance = EnergyBalance(equations)

    def _solve_initial_edges(self) -> None:
        """Compute the derivatives of the edges' unknowns at the start, where moments are balanced."""
        equations, n = self._equations, self._equations.points.n_owned
        start, velocity, vertices = equations.x[:n].copy(), equations.v[:n], equations.points.n_vertices
        frames = [term.frames for term in edged(equations)]
        edge_solve.initial_moments(equations)
        edges = EdgeSolve.begin(equations, start)
        for tangent in self.tangents:
            for scene in tangent.perturbed:
                x = start + scene.change * tangent.x
                scene.equations.state.set(x, velocity + scene.change * tangent.v)
                scene.set_frames(frames)
                edge_solve.initial_moments(scene.equations)
                scene.edges = EdgeSolve.begin(scene.equations, x)
                scene.use_frames(equations, frames)
        still = np.zeros_like(start)
        with self._solver(still, set_up=True, keep=False) as solve:
            for tangent in self.tangents:
                for scene, v in self._solve_stages(solve, tangent, still):
                    scene.end_edges(v)
                    scene.change_frames(equations)
                rates = tangent.difference(lambda scene: scene.equations.x[:n])
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
        simulation, equations, n = self.simulation, self._equations, self._equations.points.n_owned
        history, numbers = equations.integrator.saved_state()
        frames = [term.frames for term in edged(equations)]
        x, v = equations.x[:n].copy(), equations.v[:n].copy()
        before = _StepStart(simulation.time, x, v, dict(history), dict(numbers), frames)
        report = simulation.step()
        if self._static:
            self._differentiate_equilibrium(before)
        else:
            self._differentiate_step(before, fresh=report.newton_iterations == 0)
        return report

    def _differentiate_step(self, before: _StepStart, *, fresh: bool) -> None:
        equations = self._equations
        velocity, end = equations.evaluated.v[: len(equations.mass)].copy(), self.simulation.time
        usual, taken = equations.integrator, self.simulation.last_integrator
        semi = self._semi and taken is usual
        with self._solver(velocity, set_up=not semi, keep=not fresh) as solve:
            for tangent in self.tangents:
                for scene in tangent.perturbed:
                    if taken is not usual:
                        scene.equations.integrators.take(type(taken)())
                    self._begin_step(scene, before, tangent, end, semi=semi)
                for scene, v in self._solve_stages(solve, tangent, velocity):
                    scene.equations.accept(scene.equations.evaluate(v))
        if edge_solve.is_needed(equations):
            self._differentiate_edges(before)
        for tangent in self.tangents:
            for scene in tangent.perturbed:
                if scene.energy_balance is not None:
                    scene.energy_balance.record(before.x + scene.change * tangent.x)
                if taken is not usual:
                    scene.equations.follow_step(before.v + scene.change * tangent.v)
                scene.change_frames(equations)
            tangent.update()
            for scene in tangent.perturbed:
                scene.equations.reference.record_starts(end, scene.equations.x)

    def _begin_step(
        self, scene: PerturbedScene, before: _StepStart, tangent: Tangent, end: float, *, semi: bool
    ) -> None:
        """Begin the step that the simulation has taken, ``semi``-implicit or not, with a perturbed scene."""
        equations, change = scene.equations, scene.change
        equations.state.set(before.x + change * tangent.x, before.v + change * tangent.v)
        history = {
            name: values + change * tangent.history.get(name, 0.0) for name, values in before.history.items()
        }
        equations.integrator.restore(history, before.numbers)
        scene.set_frames(before.frames)
        for term in edged(equations):
            term.initialise(equations.x)
        equations.begin_step(before.time, end)
        scene.use_frames(self._equations, before.frames)
        scene.jacobian = None
        if semi:
            start = np.zeros_like(before.x)
            equations.prescribe(start)
            scene.jacobian = equations.discretisation.rows.zeros()
            at = equations.linearised(start)
            scene.prescribed_force = equations.forces.jacobian(at, 1.0, scene.jacobian)
            dense = equations.forces.dense_part(at)
            scene.dense = dense and dense.restricted(equations.step.prescribed.free)

    def _solve_stages(
        self, solve: Callable[[Array], Array], tangent: Tangent, velocity: Array
    ) -> list[tuple[PerturbedScene, Array]]:
        """Solve for the velocities (n_owned, 3) of the stages of a parameter's perturbed scenes."""

        def derivative(dv: Array) -> Array:
            """That of G if that of the stage's velocities is ``dv``."""
            residuals = tangent.difference(lambda scene: scene.residual(velocity + scene.change * dv))
            return self._free(residuals)

        change = tangent.difference(lambda scene: scene.equations.step.prescribed.velocity)
        prescribed = np.zeros_like(velocity)
        self._equations.step.prescribed.overwrite(prescribed, change)
        dv = self._solve_affine(solve, derivative, prescribed, tangent.delta)
        stages = []
        for scene in tangent.perturbed:
            scene.equations.prescribe(v := velocity + scene.change * dv)
            stages.append((scene, v))
        return stages

    def _free(self, values: Array) -> Array:
        return np.where(self._equations.step.prescribed.free, values, 0.0)

    def _differentiate_edges(self, before: _StepStart) -> None:
        """Solve for the edges' unknowns at the end of the step, where they are in equilibrium."""
        equations, n = self._equations, self._equations.points.n_owned
        edges = EdgeSolve.begin(equations, before.x)
        rates = (equations.x[:n] - before.x) / equations.step.stage.c
        for tangent in self.tangents:
            for scene in tangent.perturbed:
                scene.edges = EdgeSolve.begin(scene.equations, before.x + scene.change * tangent.x)
                scene.use_frames(equations, before.frames)
        with self._solver(rates, set_up=True, keep=False) as solve:
            for tangent in self.tangents:
                for scene, v in self._solve_stages(solve, tangent, rates):
                    scene.end_edges(v)
        edges.end(equations, equations.evaluate(rates))

    # -- equilibria --------------------------------------------------------------------------------

    def _differentiate_equilibrium(self, before: _StepStart) -> None:
        equations, integrator = self._equations, self._equations.integrator
        x, frames = equations.x[: len(before.x)].copy(), [term.frames for term in edged(equations)]
        now = _Equilibrium(before.time, self.simulation.time, x, frames)
        assert isinstance(integrator, Static)
        pseudo = integrator.pseudo_dt
        integrator.pseudo_dt = math.sqrt(MAX_GROWTH) * self._fall_time()
        equations.begin_step(now.before, now.factor)
        reach = equations.step.stage.c
        with self._solver(np.zeros_like(x), set_up=True, keep=False) as solve:
            for tangent in self.tangents:
                # sets the goals of handles
                self._force_derivative(now, tangent, np.zeros_like(x))
                prescribed = np.zeros_like(x)
                change = tangent.difference(lambda scene: scene.equations.step.prescribed.goal)
                equations.step.prescribed.overwrite(prescribed, change)
                _drop_roundoff(prescribed, x, tangent.delta)
                forces = partial(self._force_derivative, now, tangent)
                tangent.x = self._solve_affine(lambda r: reach * solve(r), forces, prescribed, tangent.delta)
                self._force_derivative(now, tangent, tangent.x)
                for scene in tangent.perturbed:
                    if scene.energy_balance is not None:
                        scene.equations.evaluate(scene.equations.stationary_velocity())
                        scene.energy_balance.record(x)
                    scene.equations.reference.record_starts(now.factor, scene.equations.x)
        integrator.pseudo_dt = pseudo
        equations.begin_step(now.before, now.factor)
        equations.evaluate(equations.stationary_velocity())

    def _force_derivative(self, now: _Equilibrium, tangent: Tangent, dx: Array) -> Array:
        """Derivative (n_owned, 3) [N] of the out-of-balance force if that of the positions is ``dx``."""

        def residual(scene: PerturbedScene) -> Array:
            equations = scene.equations
            equations.state.set(now.x + scene.change * dx, np.zeros_like(now.x))
            scene.set_frames(now.frames)
            equations.begin_step(now.before, now.factor)
            return -equations.out_of_balance()

        return self._free(tangent.difference(residual))

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
            return self._free(np.array(left.getArray(readonly=True)).reshape(values.shape))

        try:
            yield solve
        finally:
            right.destroy()
            left.destroy()
            ksp.setTolerances(*tolerances)
            ksp.setInitialGuessNonzero(guess)

    def _solve_affine(
        self, solve: Callable[[Array], Array], function: Callable[[Array], Array], start: Array, delta: float
    ) -> Array:
        """As `solve_affine`, to the round-off of forces over δ = ``delta``."""
        roundoff, points = self.simulation.roundoff / delta, self._equations.points
        solution, excess = solve_affine(
            solve, function, start, points, tolerance=self._tolerance, roundoff=roundoff
        )
        if excess != 0.0:
            raise SolverError(
                f"the tangent equations are not solved at {self.simulation.time:g}: their residual stays at "
                f"{excess:.2g} of their right side; the state is near a bifurcation, or not converged: "
                "give smaller steps, or a smaller solver.force_tolerance",
                collective=True,
            )
        return solution

    # -- results -----------------------------------------------------------------------------------

    def derivatives(self, quantity: Callable[[Problem, EnergyBalance | None], Array]) -> Array:
        """Derivatives (m, n) of a quantity (m,) of the present state with respect to the n parameters.

        Parameters
        ----------
        quantity : callable
            Takes a problem at its state, and its energy balance if reactions are needed; collective.
        """
        n, columns = self._equations.points.n_owned, []
        for tangent in self.tangents:

            def value(scene: PerturbedScene, tangent: Tangent = tangent) -> Array:
                x, v = self._equations.x[:n], self._equations.v[:n]
                scene.equations.state.set(x + scene.change * tangent.x, v + scene.change * tangent.v)
                return np.asarray(quantity(scene.problem, scene.energy_balance))

            columns.append(tangent.difference(value))
        return np.stack(columns, axis=1)


def _drop_roundoff(values: Array, base: Array, delta: float) -> None:
    """Set derivatives to 0 that are round-off only, of values that do not depend on the parameter."""
    values[np.abs(values) * delta <= 1e-14 * (1.0 + np.abs(base))] = 0.0
