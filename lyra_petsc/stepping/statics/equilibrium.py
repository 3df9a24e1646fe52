"""Static equilibrium at a load factor, by proximal steps: backward Euler from rest with growing Δτ.

A load step starts from the polynomial extrapolation of the last equilibria, with their stress in the first
Jacobian. Each solve minimises E(x) − W(x) + ‖x − x_k‖²_M / (2 Δτ²), whose Hessian is positive definite where
that of the shell alone is singular (flat, slack) or indefinite (buckling). Δτ grows while Newton's method
converges in few iterations, until the out-of-balance force is small without the last term. Loads that follow
the shape (pressure, moments, wind) are updated before every solve, under-relaxed; all but wind also change
during a solve with their own stiffness. Friction takes the normal forces of the solve before, as
`friction_balance` tells.

A snap takes many solves in which the out-of-balance force grows, while the potential energy falls. If a solve
in contact runs out of iterations, the next one starts from its iterate of least energy. With friction neither
counts: solves whose friction lags behind normal forces may let sheets slide off.

Source: pseudo-transient continuation, Kelley & Keyes, SIAM J. Numer. Anal. 35 (1998) 508-523.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array
from lyra_petsc.scene.schema import Solver
from lyra_petsc.stepping import motion_limits as limits
from lyra_petsc.stepping.directors import transport_frames
from lyra_petsc.stepping.integrators.static import Static
from lyra_petsc.stepping.newton.extrapolation import Extrapolation
from lyra_petsc.stepping.newton.force_scales import limit_roundoff
from lyra_petsc.stepping.newton.newton_trace import FailedSolve
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.statics.buckled_shape import BuckledShape
from lyra_petsc.stepping.statics.friction_balance import FrictionBalance
from lyra_petsc.stepping.statics.load_step_progress import PROGRESS, LoadStepProgress
from lyra_petsc.stepping.statics.pseudo_time import LEAP_ITERATIONS, PseudoTimeStep
from lyra_petsc.stepping.statics.relaxation import Relaxation
from lyra_petsc.stepping.statics.stability import Examination, Stability
from lyra_petsc.stepping.stepper import Attempt, Stepper

if TYPE_CHECKING:
    from lyra_petsc.stepping.statics.whole_stiffness import WholeStiffness

MAX_SOLVES = 100
"""Largest number of proximal steps in a load step."""

PATIENCE = 15
"""A load step is given up after so many proximal steps without progress."""

MAX_FAILURES = 8
"""Number of proximal steps after which a load step is given up if none has converged."""

MAX_DISPLACEMENT = 1e3
"""Displacement in a load step, over the size of the mesh, beyond which there is no equilibrium."""

MAX_IN_VAIN = 60
"""Number of proximal steps without progress since the last equilibrium after which smaller increments are
not tried."""

MAX_RESUMED = 3
"""Number of leaps in a load step that are resumed where they ended: a snap may take more iterations."""

HARD_STEP = 14
"""After a load step with more Newton iterations, the next one begins with `WholeStiffness`."""

NO_POTENTIAL = (
    "pressure beside free edges, or a moment on edges that turn, has no potential, and the symmetric part of "
    "the stiffness is indefinite"
)

HANDLE_STEP = 1e-6
"""Displacement of handles, over the mean edge length, in a finite difference of forces."""

WORSE = 2.0
"""Δτ is reduced after a solve in which the out-of-balance force grows by more than this factor."""

MAX_DESCENTS = 5
"""Largest number of unstable equilibria that are left along their lowest mode."""


@dataclasses.dataclass(frozen=True)
class EquilibriumReport:
    """Stability of the last equilibrium, iterations to find it, and a note for the user."""

    stability: Stability
    newton_iterations: int
    linear_iterations: int
    note: str


class Equilibrium:
    """Finds the equilibrium at one load factor after another; collective.

    Parameters
    ----------
    equations : StageEquations
        With the integrator `Static`; its positions are the start shape.
    stepper : Stepper
    tolerances : Solver
    spacing, size : float
        Mean edge length [m] and diagonal of the bounding box [m].
    floor : float
        Norm [N] of the residual's round-off.
    end : float
        Load factor at the end of the run.
    """

    def __init__(
        self,
        equations: StageEquations,
        stepper: Stepper,
        tolerances: Solver,
        spacing: float,
        size: float,
        floor: float,
        end: float,
    ) -> None:
        assert isinstance(equations.integrator, Static)
        self._equations, self._stepper, self._integrator = equations, stepper, equations.integrator
        self._tolerances, self._spacing, self._size, self._floor = tolerances, spacing, size, floor
        self._whole_first = False  # whether the next load step begins with it
        self._in_vain = 0
        self._friction = FrictionBalance(equations, spacing, end)
        self._whole_stiffness: WholeStiffness | None = None
        if equations.active.following:
            from lyra_petsc.stepping.statics.whole_stiffness import (
                WholeStiffness,  # needed with loads that follow the shape only
            )

            self._whole_stiffness = WholeStiffness(equations, stepper.tangent, self._examine, self._balanced)
        # load factor λ of the last equilibrium, change of the loads over that of λ [N], and tangent dx/dλ [m]
        self._last_factor, self._load_rate = 0.0, np.zeros((equations.points.n_owned, 3))
        self._tangent: Array | None = None
        self._pseudo_time = PseudoTimeStep(
            self._integrator,
            spacing,
            leaps=not equations.active.viscous,
            contact=equations.contact is not None,
            factors=stepper.solver.linear.factors,
        )
        self._extrapolation = Extrapolation(equations.points.comm)
        self._follows = bool(equations.active.viscous or equations.active.following)
        equations.take_loads(factor=0.0)
        equations.begin_step(0.0, 0.0)
        force = equations.out_of_balance()
        self._scale = self._norm(force)
        # if the sheet slides, forces that hold its start shape would push it along
        held = not equations.near
        if held and self._scale > floor and not self._unstable():
            equations.take_loads(unbalanced=-force)

    def _unstable(self) -> bool:
        """Whether the start shape with the forces that hold it is unstable, as if compressed; collective.

        Reducing these forces step by step would then lead to a distant folded shape. Without them the first
        solve finds the nearest equilibrium.
        """
        with self._examine() as examination:
            return examination.stability.stable is False

    def _examine(self) -> Examination:
        return Examination(self._equations, self._size)

    def attempt(self, before: float, factor: float, *, limited: bool = True) -> Attempt:
        """Find the equilibrium at load factor ``factor``; on failure the state is restored; collective.

        ``limited``: it counts as a failure if much lands in a large increment.
        """
        found = self._by_whole_stiffness(before, factor) if self._whole_first else None
        if found is not None:
            return found
        attempt = self._by_proximal_steps(before, factor, limited=limited)
        hard = not attempt.converged or attempt.newton_iterations > HARD_STEP
        if not (attempt.converged or self._whole_first or self._stepper.solver.stopped_by):
            found = self._by_whole_stiffness(before, factor)
        self._whole_first = hard
        if found is None:
            return attempt
        newton = found.newton_iterations + attempt.newton_iterations
        return dataclasses.replace(
            found, newton_iterations=newton, linear_iterations=attempt.linear_iterations
        )

    def _by_whole_stiffness(self, before: float, factor: float) -> Attempt | None:
        """Find the equilibrium by Newton's method with the whole stiffness; collective."""
        if self._whole_stiffness is None:
            return None
        equations = self._equations
        equations.take_loads(factor=factor)
        guess = self._extrapolation.extrapolate(factor, before, equations.x[: equations.points.n_owned])
        found = self._whole_stiffness.find(before, factor, guess)
        if found is not None:
            self._record(factor)
            self._tangent = None
        return found

    def _by_proximal_steps(self, before: float, factor: float, *, limited: bool) -> Attempt:
        """Find the equilibrium as described at the top of the module; collective."""
        equations, n = self._equations, self._equations.points.n_owned
        x = equations.x[:n].copy()
        equations.take_loads(factor=factor)
        newton = linear = solves = resumed = 0
        last, solved_once = np.inf, False
        contact = equations.contact is not None
        judges_energy = contact and self._is_held()
        self._integrator.predicted = self._extrapolation.extrapolate(factor, before, x) - x
        progress, relaxation = LoadStepProgress(), Relaxation(equations.points.comm)
        self._pseudo_time.begin_load_step()
        self._friction.begin_step()
        attempt = Attempt(False, 0, 0, 0.0)
        while True:
            force, fastest = self._out_of_balance(before, factor)
            if not solves:
                self._pseudo_time.start(fastest)
                self._predict_by_tangent(before, factor)
                frozen = equations.step.frozen
            progress.record_force(force, attempt.linear_iterations if solves else None)
            if solves and judges_energy and not limits.has_friction_pairs(equations):
                progress.record_potential(self._potential_energy(x))
            balanced = solved_once and self._balanced(force, last)
            settled = self._friction.is_rough or (balanced and self._friction.is_settled())
            if settled:
                self._friction.judge_landing(factor - before, limited=limited)
            if self._friction.lands:
                message = "much landed in the increment"
                break
            if settled:
                self._friction.record_success(factor - before)
                self._record(factor)
                self._pseudo_time.sufficed = self._integrator.pseudo_dt
                linear += self._compute_tangent(x, before, factor)
                return Attempt(True, newton, linear, force, at_roundoff=attempt.at_roundoff)
            message = self._failure_message(solves, progress, x, solved_once=solved_once)
            if self._friction.keeps_first_state(failed=bool(message) or not attempt.converged):
                continue
            if message:
                break
            if attempt.converged:
                if force > WORSE * last:
                    self._pseudo_time.shrink()
                self._friction.accept_substep()
            last = force
            if balanced:  # except for friction
                progress.restart()
                last, fastest = self._out_of_balance(before, factor)
                self._pseudo_time.restart(fastest)
            if self._follows:
                linear += self._update_loads(relaxation, before, factor, first=solves == 0)
            leap, begin = self._pseudo_time.is_leap, equations.x[:n].copy()
            attempt = self._proximal_step(before, factor, LEAP_ITERATIONS if leap else None)
            if self._follows:
                relaxation.record(equations.step.loads.force_at(equations.x))
            equations.take_loads(override=None, following=None)
            self._integrator.predicted = None
            self._integrator.alternatives = []
            solves += 1
            newton += attempt.newton_iterations
            linear += attempt.linear_iterations
            lags = attempt.converged and self._friction.lags(begin)
            if lags and self._pseudo_time.shorten_to_repeat():
                equations.state.set(begin, np.zeros_like(x))
                attempt = dataclasses.replace(attempt, converged=False)
            elif attempt.converged:
                if not solved_once:  # the force before is smaller if handles move
                    progress.restart()
                solved_once = True
                transport_frames(equations)  # edges may turn far until they are in equilibrium
                self._pseudo_time.record_success(attempt.newton_iterations)
            elif leap and resumed < MAX_RESUMED and self._resume_from_lowest(attempt):
                resumed += 1
            elif leap:
                self._pseudo_time.record_failed_leap(first=not solved_once)
            elif self._stepper.solver.linear_failed or self._stepper.solver.stopped_by:
                break
            else:
                if contact:
                    self._resume_from_lowest(attempt)
                self._pseudo_time.record_failure()
        slides = self._friction.record_failure(factor - before) if message and solved_once else ""
        if slides:
            message = f"{message}; {slides}"
        self._pseudo_time.sufficed = 0.0
        self._in_vain += solves - progress.last_by_force if solved_once and not self.lands else 0
        stuck = attempt.failed_solve or self._failed_solve(before, factor, progress, x)
        equations.x[:n] = x
        equations.points.update_ghosts(equations.x)
        transport_frames(equations, frozen)
        equations.active.restore_contacts(self._friction.contacts)
        return dataclasses.replace(
            attempt,
            converged=False,
            newton_iterations=newton,
            linear_iterations=linear,
            message=message if slides else attempt.message or message,
            failed_solve=stuck,
        )

    def _predict_by_tangent(self, before: float, factor: float) -> None:
        """Set the predictions along the tangent of the last equilibrium; collective."""
        if before != self._last_factor:
            return
        self._load_rate = self._equations.out_of_balance() / (factor - before)
        if self._tangent is not None:
            self._integrator.alternatives = self._extrapolation.tangent_predictions(factor, self._tangent)

    def _compute_tangent(self, start: Array, before: float, factor: float) -> int:
        """Compute the tangent dx/dλ of the equilibrium just found; returns linear iterations; collective.

        Loads are assumed to change further as in this load step, and handles to move further as from
        positions ``start`` (n_owned, 3) [m].
        """
        equations, n = self._equations, len(start)
        step = factor - before
        moved = np.where(equations.step.prescribed.free, 0.0, equations.x[:n] - start)
        (largest,) = equations.points.global_max(float(np.abs(moved).max(initial=0.0)))
        rate = self._load_rate
        if equations.near:
            self._tangent = None  # the first guess is another
            return 0
        if largest > 0.0:
            x, part = equations.x.copy(), HANDLE_STEP * self._spacing / largest
            here = equations.out_of_balance()
            equations.x[:n] += part * moved
            equations.points.update_ghosts(equations.x)
            equations.change()
            rate = rate + (equations.out_of_balance() - here) / (part * step)
            equations.x[:] = x
            equations.change()
        if self._whole_stiffness is None:
            self._tangent, iterations = self._stepper.tangent(rate)
        else:
            loads = self._whole_stiffness.linearise_loads(before, factor)
            self._tangent, iterations = self._whole_stiffness.tangent(rate, loads)
        if self._tangent is not None:
            self._tangent += moved / step
        return iterations

    def _update_loads(self, relaxation: Relaxation, before: float, factor: float, *, first: bool) -> int:
        """Set the loads of the next solve to those of the present shape, with their stiffness.

        Returns linear iterations; collective.
        """
        equations, now = self._equations, self._equations.step.loads.force.copy()
        if self._whole_stiffness is None:
            equations.take_loads(override=relaxation.relax(now))
            return 0
        loads = self._whole_stiffness.linearise_loads(before, factor)
        displacement, iterations = None, 0
        if equations.active.viscous:  # the wind's stiffness is not known
            pass
        elif not first:
            displacement, iterations = self._whole_stiffness.tangent(equations.out_of_balance(), loads)
        elif self._integrator.alternatives and self._tangent is not None:
            displacement = (factor - before) * self._tangent
        if displacement is None:
            now = relaxation.relax(now)
        else:
            now = now + self._whole_stiffness.skew_force(loads, displacement)
        equations.take_loads(override=now, following=loads)
        return iterations

    def _is_held(self) -> bool:
        """Whether handles hold vertices, and loads have a potential: it is then bounded below; collective."""
        equations = self._equations
        springs = any(not term.registration.of_contact for term in equations.active.external)
        holds = springs or len(equations.step.prescribed.indices) > 0
        return not self._follows and any(equations.points.global_max(float(holds)))

    def _potential_energy(self, start: Array) -> float:
        """Energy [J] without friction, less the work of loads from ``start`` (n_owned, 3); collective."""
        equations, frozen = self._equations, self._equations.step.frozen
        friction = None if equations.contact is None else equations.contact.friction
        terms = [term for term in equations.active.elastic if term is not friction]
        energy = sum(float(term.energies(equations.x, frozen[term]).sum()) for term in terms)
        energy -= float(np.vdot(equations.step.loads.force, equations.x[: len(start)] - start))
        return float(equations.points.global_sum(energy)[0])

    def _proximal_step(self, before: float, factor: float, limit: int | None) -> Attempt:
        """One proximal step; ``limit`` bounds Newton iterations, and then also displacements; collective."""
        snes, convergence = self._stepper.solver.snes, self._stepper.solver.convergence
        maximum = snes.getTolerances()[3]
        snes.setTolerances(max_it=min(maximum, limit or maximum))
        convergence.max_displacement = self._size if limit else np.inf
        attempt = self._stepper.attempt(before, factor)
        self._stepper.solver.snes.setTolerances(max_it=maximum)
        self._stepper.solver.convergence.max_displacement = np.inf
        return attempt

    def _resume_from_lowest(self, attempt: Attempt) -> bool:
        """Set the state to the iterate of least energy of a solve that ran out of iterations; collective.

        Returns whether it did: the energy must have fallen. Not with loads that follow the shape, nor with
        friction, whose forces do not follow the normal forces in a solve: sheets might slide off.
        """
        equations = self._equations
        ran_out = attempt.newton_iterations >= LEAP_ITERATIONS
        if not ran_out or self._follows or limits.has_friction_pairs(equations):
            return False
        lowest = self._stepper.lowest_energy_positions()
        if lowest is None:
            return False
        equations.state.set(lowest, np.zeros_like(lowest))
        transport_frames(equations)
        return True

    def settle(self, before: float, factor: float) -> EquilibriumReport:
        """Leave the equilibrium just found along its lowest mode while it is unstable; collective."""
        equations, n = self._equations, self._equations.points.n_owned
        newton = linear = followed = 0
        message = ""
        while True:
            friction_note = self._friction.note()
            with self._examine() as examination:
                found = examination.stability
                if found.stable is not False:
                    break
                mode = examination.lowest_mode()
                if mode is None:
                    message = "its lowest mode was not found"
                elif self._whole_stiffness is not None and self._whole_stiffness.skew_part_stabilises(
                    found, mode, factor
                ):
                    found, message = Stability(reason=NO_POTENTIAL), ""
                    break
                elif examination.is_wrinkle(mode):
                    message = (
                        "sheets without bending wrinkle as finely as the mesh, which is not followed; give a "
                        "bending stiffness"
                    )
                elif followed == MAX_DESCENTS:
                    message = f"its lowest mode was followed {followed} times"
            if message:
                break
            x = equations.x[:n].copy()
            self._pseudo_time.sufficed = 0.0
            assert mode is not None
            buckled = BuckledShape(equations, self._examine, before, factor, self._size)
            attempt = self.attempt(before, factor, limited=False) if buckled.find(mode) else None
            if attempt is not None:
                newton += attempt.newton_iterations
                linear += attempt.linear_iterations
            if attempt is None or not attempt.converged:
                equations.state.set(x, np.zeros_like(x))
                equations.begin_step(before, factor)
                equations.evaluate(equations.stationary_velocity())
                message = "from its lowest mode no other was found"
                break
            followed += 1
        note = _note(found, followed, message)
        note = "; ".join(part for part in (note, friction_note) if part)
        return EquilibriumReport(found, newton, linear, note)

    def saved_state(self, factor: float) -> tuple[dict[str, Array], dict[str, Any]]:
        """Arrays (n_owned, 3) and numbers of a checkpoint at the equilibrium at ``factor``; collective."""
        self._extrapolation.record(factor, self._equations.x[: self._equations.points.n_owned].copy())
        arrays, past = self._extrapolation.saved_state()
        numbers = {"scale": self._scale, "in_vain": self._in_vain, "sufficed": self._pseudo_time.sufficed}
        numbers |= self._friction.saved_state()
        if self._tangent is not None:
            arrays["rate"] = self._tangent
        return arrays, numbers | {"extrapolation": past}

    def restore(self, arrays: Mapping[str, Array], saved: Mapping[str, Any], factor: float) -> None:
        """Restore a `saved_state`."""
        self._scale, self._in_vain = saved["scale"], saved["in_vain"]
        self._friction.restore(saved)
        self._pseudo_time.sufficed = saved["sufficed"]
        self._last_factor = factor
        self._tangent = np.array(arrays["rate"]) if "rate" in arrays else None
        x = self._equations.x[: self._equations.points.n_owned].copy()
        self._extrapolation.restore(arrays, saved["extrapolation"], factor, x)

    @property
    def lands(self) -> bool:
        """Whether the last load step is to be repeated with a smaller increment, as much landed in it."""
        return self._friction.lands

    @property
    def in_vain(self) -> bool:
        """Whether attempts since the last equilibrium show that a smaller increment would not help."""
        return self._in_vain >= MAX_IN_VAIN or self._friction.in_vain

    def _failure_message(
        self, solves: int, progress: LoadStepProgress, before: Array, *, solved_once: bool
    ) -> str:
        """Why no further proximal step is taken, or an empty string; collective.

        ``before`` (n_owned, 3) [m] are the positions at the start of the load step.
        """
        if not solved_once:
            return "no proximal step was found" if solves >= MAX_FAILURES else ""
        moved = float(np.abs(self._equations.x[: len(before)] - before).max(initial=0.0))
        moved = self._equations.points.comm.allreduce(moved, MPI.MAX)
        if moved > MAX_DISPLACEMENT * self._size:
            return f"no equilibrium within {moved:.1g} m of the start, as if nothing held the sheet"
        idle = solves - progress.last
        if idle >= PATIENCE:
            return f"no equilibrium: the last {idle} of {solves} proximal steps came no nearer"
        return f"no equilibrium within {solves} proximal steps" if solves >= MAX_SOLVES else ""

    def _failed_solve(
        self, before: float, factor: float, progress: LoadStepProgress, x: Array
    ) -> FailedSolve:
        """The state that the proximal steps from positions x (n_owned, 3) [m] have reached; collective."""
        equations, n = self._equations, self._equations.points.n_owned
        equations.begin_step(before, factor)
        force = equations.out_of_balance()
        return FailedSolve(
            iterations=tuple(progress.history),
            norm=self._norm(force),
            time=factor,
            velocity=np.zeros_like(x),
            position=equations.x[:n].copy(),
            residual=-force,
            forces={"loads": -equations.step.loads.force, "internal": equations.step.loads.force - force},
            prescribed=equations.step.prescribed.mask[:n].copy(),
            snes_reason=0,
            ksp_reason=0,
            linear_residuals=np.empty(0),
        )

    def _out_of_balance(self, before: float, factor: float) -> tuple[float, float]:
        """Norm [N] of the out-of-balance force, and the largest acceleration [m/s²] by it; collective."""
        equations = self._equations
        equations.begin_step(before, factor)
        force = equations.out_of_balance()
        norm = self._norm(force)
        if not np.isfinite(norm):  # an obstacle has moved into the sheet
            return norm, 0.0
        n = equations.points.n_vertices
        fastest = float(np.abs(force[:n] / equations.mass[:n, None]).max(initial=0.0))
        if equations.points.n_edges_global:  # loads may act on edges alone, which have no mass
            mass = (
                equations.points.global_sum(float(equations.mass.sum()))[0]
                / equations.points.n_vertices_global
            )
            fastest = max(fastest, float(np.abs(force[n:]).max(initial=0.0)) / mass)
        return norm, equations.points.comm.allreduce(fastest, MPI.MAX)

    def _largest_force(self) -> float:
        """Norm [N] of the largest part of the forces here and in all equilibria found; collective.

        Not that on the way to them: in a snap it may be 1e5 times as large.
        """
        return max(self._scale, self._equations.forces.largest_force())

    def _record(self, factor: float) -> None:
        """Record that the present state is the equilibrium at load factor ``factor``; collective."""
        self._in_vain, self._last_factor, self._scale = 0, factor, self._largest_force()

    def _balanced(self, force: float, last: float) -> bool:
        """Whether a force of this norm [N] counts as zero; ``last`` [N] is that one proximal step before.

        Below the round-off floor proximal steps are taken as long as they reduce the force.
        """
        if force <= self._tolerances.force_tolerance * self._largest_force():
            return True
        return PROGRESS * last <= force <= max(self._floor, limit_roundoff(self._equations.evaluated))

    def _norm(self, vector: Array) -> float:
        return float(np.sqrt(self._equations.points.comm.allreduce(float(np.vdot(vector, vector)))))


def _note(found: Stability, followed: int, message: str) -> str:
    """Note for the user on the stability of an equilibrium, or an empty string."""
    if found.stable is None:
        return f"whether the equilibrium is stable is not known: {found.reason}"
    if not found.stable:
        modes = "1 way" if found.negative == 1 else f"{found.negative} ways"
        return f"the equilibrium is unstable, it gives way in {modes} (negative pivots): {message}"
    notes = []
    if followed:
        times = "once" if followed == 1 else f"{followed} times"
        notes.append(
            f"the first equilibrium was unstable; its lowest mode was followed {times}, to a stable one"
        )
    if found.rigid:
        notes.append(f"nothing holds the sheet in {found.rigid} rigid motions")
    return "; ".join(notes)
