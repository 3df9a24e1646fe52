"""The stepper: makes one attempt at a step, with the linear solver that is in use."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError
from lyra_petsc.linear import presets, reasons
from lyra_petsc.linear.hierarchy import Surface
from lyra_petsc.phases import FROZEN
from lyra_petsc.scene.schema import Scene
from lyra_petsc.stepping import edge_solve
from lyra_petsc.stepping import motion_limits as limits
from lyra_petsc.stepping.directors import turn_with_triangles, update_frames
from lyra_petsc.stepping.edge_solve import EdgeSolve
from lyra_petsc.stepping.newton.convexity import Convexity
from lyra_petsc.stepping.newton.extrapolation import Extrapolation
from lyra_petsc.stepping.newton.force_scales import expected_iterations
from lyra_petsc.stepping.newton.initial_guess import has_start
from lyra_petsc.stepping.newton.newton_trace import FailedSolve
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.stage_solver import StageSolver
from lyra_petsc.stepping.time_step import Evaluation
from lyra_petsc.terms.protocols import HoldsTogether

if TYPE_CHECKING:
    from lyra_petsc.contact.collisions import RefusedDisplacement


@dataclass(frozen=True)
class Attempt:
    """Outcome of one attempt at a step.

    Attributes
    ----------
    residual : float
        Norm [N] of the last residual.
    remaining : float
        Estimated displacement [m] of further Newton iterations.
    message : str
        Why the attempt failed; else empty.
    at_roundoff : bool
        Whether the solve ended because the residual was round-off.
    refused : RefusedDisplacement or None
        A displacement that collides, where the step has no start without a collision.
    touches : bool
        Whether it failed because something touches in a step without contact in its equations.
    crosses : bool
        Whether it failed because the step has no start without a collision.
    failed_solve : FailedSolve or None
        The last iterate and residual of a failed attempt.
    """

    converged: bool
    newton_iterations: int
    linear_iterations: int
    residual: float
    remaining: float = math.inf
    message: str = ""
    at_roundoff: bool = False
    refused: RefusedDisplacement | None = None
    touches: bool = False
    crosses: bool = False
    failed_solve: FailedSolve | None = None


MAX_SOLVES = 8
"""Largest number of solves of a step in which friction takes the contacts that the one before has found."""

BEYOND_LIMIT = "the handles would stretch the sheet beyond material.stretch_limit"
"""Message of an attempt whose prescribed motion leaves no start within the limits of all terms."""

WOULD_CROSS = "something would pass through the sheet"
"""Message of an attempt whose step would lead through a contact."""


class Stepper:
    """Attempts steps, and changes the linear solver.

    Parameters
    ----------
    scene : Scene
    equations : StageEquations
    surface : Surface
    spacing : float
        Mean edge length [m], for the step tolerance.
    floor : float
        Norm [N] of the residual's round-off.

    Attributes
    ----------
    solver : StageSolver
        With the linear solver in use.
    presets : list of str
        The linear solver in use and those to try next if it breaks down.
    our_options : list of str
        Options that were set because the user did not.

    Raises
    ------
    InputError
        For options that PETSc refuses.
    """

    def __init__(
        self, scene: Scene, equations: StageEquations, surface: Surface, spacing: float, floor: float
    ) -> None:
        self._scene, self._equations, self._surface = scene, equations, surface
        self._spacing, self._floor, self._n = spacing, floor, equations.points.n_owned
        # presets and state of Newton's method, while another integrator replaces the scene's
        self._suspended: tuple[list[str], dict[str, float]] | None = None
        self._extrapolation = Extrapolation(equations.points.comm)
        self.our_options: list[str] = []
        self._take_integrator(self._candidates())

    # -- the linear solver ---------------------------------------------------------------------------

    @property
    def preset(self) -> str:
        """Name of the linear solver in use."""
        return self.presets[0]

    def _candidates(self) -> list[str]:
        """Linear solvers to try in order; collective."""
        equations, scene, points = self._equations, self._scene, self._equations.points
        step = 0.0 if scene.time.step == "auto" else scene.time.step
        static = scene.time.scheme == "static"
        return presets.candidates(
            points.n_vertices_global if static else points.n_global,  # edges hardly enlarge the factors
            points.comm.size,
            static=static,
            newton=equations.integrator.iterates,
            iterations=0.0 if static else expected_iterations(equations.forces, step),
            contact=equations.contact is not None,
            tied=any(isinstance(term, HoldsTogether) for term in equations.active.elastic),
        )

    def _take_integrator(self, candidates: list[str]) -> None:
        """Solve with the first of these for Newton's method, or for one linear solve."""
        self._iterates, self.presets = self._equations.integrator.iterates, candidates
        self._convexity = Convexity(self._scene.solver.hessian if self._iterates else "regularised")
        self._create_solver()

    def _create_solver(self) -> None:
        self.solver = StageSolver(
            self._scene,
            self._equations,
            self._surface,
            spacing=self._spacing,
            floor=self._floor,
            candidates=tuple(self.presets),
            convexity=self._convexity,
            extrapolation=self._extrapolation,
        )
        self.our_options += [name for name in self.solver.filled if name not in self.our_options]

    def follow_integrator(self) -> None:
        """Change between Newton's method and one linear solve as the integrator demands; collective."""
        if self._equations.integrator.iterates == self._iterates:
            return
        time, step = self.solver.ts.getTime(), self.solver.ts.getStepNumber()
        suspended, saved = self._suspended, self.solver.newton.saved_state()
        self.destroy()
        if suspended is None:
            self._suspended = self.presets, saved
            self._take_integrator(self._candidates())
        else:
            self._suspended = None
            self._take_integrator(suspended[0])
            self.solver.newton.restore(suspended[1])
        self.start(time, step)

    def next_preset(self) -> str | None:
        """Change to the next linear solver and return its name, or None if none is left; collective."""
        if len(self.presets) < 2:
            return None
        time, step = self.solver.ts.getTime(), self.solver.ts.getStepNumber()
        self.destroy()
        self.presets.pop(0)
        self._create_solver()
        self.start(time, step)
        return self.preset

    def destroy(self) -> None:
        """Free all PETSc objects and remove the options that were filled in; collective."""
        self.solver.destroy()

    # -- a step ----------------------------------------------------------------------------------------

    def start(self, time: float, step: int) -> None:
        """Set time [s] and step number, and take the velocities from the equations' state."""
        self.solver.ts.setTime(time)
        self.solver.ts.setStepNumber(step)
        self.solver.velocity.setArray(self._equations.v[: self._n].ravel())

    def attempt(self, t0: float, t1: float) -> Attempt:
        """Try the step from t0 to t1 [s]; the state changes only on success; collective."""
        equations, solver, n = self._equations, self.solver, self._n
        self._record(t0)
        with PETSc.Log.Event(FROZEN):
            equations.begin_step(t0, t1)
        number = solver.ts.getStepNumber()
        start, refused = limits.find_start(equations)
        if start is None or not has_start(equations, start):
            crosses = start is None
            message, failed = WOULD_CROSS if crosses else BEYOND_LIMIT, solver.solve_without_start()
            return Attempt(
                False, 0, 0, math.inf, message=message, refused=refused, crosses=crosses, failed_solve=failed
            )
        solves = [solver.solve(start)]
        while self._iterates and len(solves) < MAX_SOLVES and (reached := solves[-1].evaluation) is not None:
            if not limits.follow_contacts(equations, reached):
                break
            solves.append(solver.solve(start, reached.v[:n]))
        solution, message = solves[-1].evaluation, solves[-1].message
        touches = False
        if solution is not None and not equations.step.in_contact:
            touches = not limits.stays_apart(equations, equations.revisit(solution))
            solution = equations.evaluated  # with the ghosts of pairs on the way
        outcome = solver.convergence
        norm, remaining, at_roundoff = outcome.norm, outcome.remaining, outcome.at_roundoff
        failure: FailedSolve | None = None
        if solution is None:
            failure = solver.failed_solve()
        elif not touches:
            before = equations.x[:n], equations.v[:n]
            equations.accept(self._turn_directors(solution))
            if edge_solve.is_needed(equations):
                edges = EdgeSolve.begin(equations, before[0])
                solves.append(solver.solve())
                rates, message = solves[-1].evaluation, solves[-1].message
                failure = solver.failed_solve() if rates is None else None
                edges.end(equations, rates)
                if failure is not None:
                    equations.state.set(*before)
        newton = sum(solve.newton_iterations for solve in solves)
        linear = sum(solve.linear_iterations for solve in solves)
        solver.ts.setTimeStep(t1 - t0)
        if failure is None and not touches:
            self.start(t1, number + 1)
            return Attempt(True, newton, linear, norm, remaining, at_roundoff=at_roundoff)
        solver.ts.setTime(t0)
        solver.ts.setStepNumber(number)
        solver.ts.setConvergedReason(PETSc.TS.ConvergedReason.CONVERGED_ITERATING)
        if not touches and solver.improve_factors():
            return self.attempt(t0, t1)
        return Attempt(
            False, newton, linear, outcome.norm, message=message, touches=touches, failed_solve=failure
        )

    def _turn_directors(self, solution: Evaluation) -> Evaluation:
        """The solution of one linear solve, whose directors turn with their triangles if they turn far."""
        equations = self._equations
        if self._iterates or not equations.active.with_edges:
            return solution
        staying = equations.stationary_velocity()
        increment = solution.v[: self._n] - staying
        if turn_with_triangles(equations, staying, increment):
            solution = equations.evaluate(staying + increment)
        update_frames(equations, solution.x)
        return solution

    def balance_edge_moments(self, floor: float) -> bool:
        """Solve for edge unknowns until moments on edges balance at the start shape, to ``floor`` [N];
        return whether they do; collective.
        """
        equations = self._equations
        before = np.inf
        while floor < (moments := edge_solve.initial_moments(equations)) < before:
            before = moments if not self._iterates else 0.0
            edges = EdgeSolve.begin(equations, equations.x[: self._n].copy())
            rates = self.solver.solve().evaluation
            edges.end(equations, rates)
            self.start(equations.step.start, 0)
            if rates is None:
                return False
        return True

    def tangent(self, force: Array) -> tuple[Array | None, int]:
        """As `NewtonCallbacks.tangent`, with the linear solver in use; collective."""
        return self.solver.newton.tangent(force)

    def lowest_energy_positions(self) -> Array | None:
        """Positions (n_owned, 3) of the iterate of least energy in the last solve, or None if that is where
        Newton's method started; collective.
        """
        velocity = self.solver.newton.globalisation.lowest_iterate()
        if velocity is None:
            return None
        return self._equations.evaluate(velocity).x[: self._n].copy()

    def monitor(self) -> None:
        """Call the TS monitors that the user asked for; collective."""
        ts = self.solver.ts
        try:
            ts.monitor(ts.getStepNumber(), ts.getTime(), self.solver.velocity)
        except PETSc.Error as error:
            asked = [f"-{name}" for name in PETSc.Options().getAll() if name.startswith("ts_monitor")]
            raise InputError(
                f"PETSc cannot: {reasons.error_message(error)}", key=" or ".join(sorted(asked))
            ) from None

    # -- checkpoints -----------------------------------------------------------------------------------

    def saved_state(self, time: float) -> tuple[dict[str, Array], dict[str, Any]]:
        """Arrays (n_owned, 3) and numbers of a checkpoint at ``time`` [s]; collective."""
        arrays: dict[str, Array] = {}
        names, newton = self._suspended or (self.presets, self.solver.newton.saved_state())
        numbers: dict[str, Any] = {"preset": names[0], **newton}
        # a resumed run has no preconditioner to reuse, and must behave alike
        self.solver.linear.reuse.discard()
        if self._record(time):
            arrays, numbers["extrapolation"] = self._extrapolation.saved_state()
        return arrays, numbers

    def _record(self, time: float) -> bool:
        """Record the velocities at ``time`` [s], where the scene's integrator extrapolates them, also while
        another one replaces it; return whether it does; collective.
        """
        extrapolates = not self._iterates or self._suspended is not None
        if extrapolates:
            self._extrapolation.record(time, self._equations.v[: self._n])
        return extrapolates

    def restore(
        self, arrays: Mapping[str, Array], numbers: Mapping[str, Any], time: float, step: int
    ) -> None:
        """Restore a `saved_state` for the state at ``time`` [s], after ``step`` steps; collective."""
        while numbers["preset"] in self.presets[1:]:
            self.next_preset()
        self.solver.newton.restore(numbers)
        if not self._iterates:
            v = self._equations.v[: self._n]
            self._extrapolation.restore(arrays, numbers.get("extrapolation", {}), time, v)
        self.start(time, step)
