"""Static equilibrium at a load factor, by proximal steps: backward Euler from rest with growing Δτ.

A load step begins where the polynomial through the last equilibria leads, with their stress in the first
Jacobian. Each solve minimises E(x) − W(x) + ‖x − x_k‖²_M / (2 Δτ²), which has a positive-definite Hessian
where the shell alone is singular (flat, slack) or indefinite (buckling). Δτ grows while Newton finds it easy,
until the out-of-balance force is small without the last term. Loads that follow the shape (pressure, wind)
are taken anew before every solve, under-relaxed; pressures change in it along their own stiffness. Friction
is taken anew, too: a sheet that comes to lie on something in a load step is held there by the forces found on
the way, and in equilibrium by what normal forces there allow.

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
from lyra_petsc.stepping.extrapolation import Extrapolation
from lyra_petsc.stepping.friction_balance import LAG, FrictionBalance
from lyra_petsc.stepping.integrators.static import Static
from lyra_petsc.stepping.newton_trace import FailedSolve, Iteration
from lyra_petsc.stepping.relaxation import Relaxation
from lyra_petsc.stepping.stability import Examination, Stability
from lyra_petsc.stepping.stage_equations import StageEquations
from lyra_petsc.stepping.stepper import Attempt, Stepper

if TYPE_CHECKING:
    from lyra_petsc.stepping.whole_stiffness import WholeStiffness

MOST_SOLVES = 100
"""Proximal steps after which a load step is given up."""

PATIENCE, LESS = 15, 0.9
"""Proximal steps after which it is given up if none left less than this part of the least force so far."""

AT_FIRST = 8
"""Proximal steps after which it is given up if Newton found none."""

FAR = 1e3
"""Sizes of the mesh from where the load step began beyond which there is no rest."""

MOST_IN_VAIN = 60
"""Proximal steps no nearer since the last equilibrium, after which a smaller increment is no help."""

EASY, FAIR = 6, 15
"""Newton iterations up to which Δτ grows fast, and up to which it grows."""

GROW_FAST, GROW, SHRINK = 10.0, 3.0, 0.2

LEAP, LEAP_ITERATIONS = 1e3, 30
"""Further growth of Δτ, until such a solve has taken more iterations; so it is with what sufficed before."""

MOST_RESUMED = 3
"""Such solves in a load step that are gone on with where they ended: a snap may take more iterations."""

BELOW, RISE = 0.5, 2.0
"""With contact, how far Δτ may grow over one that was too long, and by what that grows in each solve: sheets
fall for a while before they rest, during which longer ones fail again and again.
"""

LONGEST = 1e7
"""Largest Δτ over the first one: beyond it the last term is round-off."""

ANY = float(np.finfo(np.float64).max)
"""Beyond all Δτ."""

HARD = 14
"""Newton iterations of a load step after which all of the stiffness is tried first in the next one."""

NO_POTENTIAL = (
    "pressure beside free edges has no potential, and the symmetric part of the stiffness is indefinite"
)

NUDGE = 1e-6
"""Of an edge, by which handles are moved to see what force that takes."""

SLIDING = 5
"""Proximal steps that lead farther off after which a load step in which all slides is given up."""

WORSE = 2.0
"""Growth of the out-of-balance force in a solve after which Δτ was too long."""


MOST_DESCENTS = 5
"""How often an unstable equilibrium is left."""


@dataclasses.dataclass(frozen=True)
class EquilibriumReport:
    """How the last equilibrium stands, what it took to get there, and what there is to tell."""

    stability: Stability
    newton_iterations: int
    linear_iterations: int
    note: str


class Equilibrium:
    """Finds the equilibrium at one load factor after another; collective.

    Parameters
    ----------
    system : StageEquations
        With the integrator `Static`; its positions are the start shape.
    stepper : Stepper
    tolerances : Solver
    spacing, size : float
        Mean edge length [m] and diagonal of the bounding box [m].
    floor : float
        Norm [N] of the residual's round-off.
    """

    def __init__(
        self,
        system: StageEquations,
        stepper: Stepper,
        tolerances: Solver,
        spacing: float,
        size: float,
        floor: float,
    ) -> None:
        assert isinstance(system.integrator, Static)
        self._system, self._stepper, self._integrator = system, stepper, system.integrator
        self._tolerances, self._spacing, self._size, self._floor = tolerances, spacing, size, floor
        self._longest, self._careful = LONGEST, 1.0
        self._whole = False  # whether all of the stiffness is tried first
        self._in_vain = 0
        self._friction = FrictionBalance(system)
        self._pressures: WholeStiffness | None = None
        if system.active.following:
            from lyra_petsc.stepping.whole_stiffness import WholeStiffness  # of use for nothing else

            self._pressures = WholeStiffness(system, stepper.tangent, self._examine, self._balanced)
        # the last equilibrium, how it changes with the load factor [m], and what loads change by [N]
        self._found, self._pull = 0.0, np.zeros((system.points.n_owned, 3))
        self._rate: Array | None = None
        # factors tell at once how far the first load would lead
        self._sufficed = ANY if stepper.linear.factors else 0.0
        self._extrapolation = Extrapolation(system.points.comm)
        self._follows = bool(system.active.viscous or system.active.following)
        system.applied.factor = 0.0
        system.begin_step(0.0, 0.0)
        force, _ = system.out_of_balance()
        self._scale = self._norm(force)
        if self._scale > floor and not self._unstable():
            system.applied.unbalanced = -force

    def _unstable(self) -> bool:
        """Whether the start shape would leave the forces that hold it, as a compressed one does; collective.

        Where they were lessened step by step it would fold far away; let go at once it finds the next shape.
        """
        with self._examine() as examination:
            return examination.stability.stable is False

    def _examine(self) -> Examination:
        return Examination(self._system, self._spacing, self._size)

    def attempt(self, before: float, factor: float) -> Attempt:
        """Seek the equilibrium at load factor ``factor``; on failure the state is the one before."""
        found = self._by_whole_stiffness(before, factor) if self._whole else None
        if found is not None:
            return found
        attempt = self._by_proximal_steps(before, factor)
        hard = not attempt.converged or attempt.newton_iterations > HARD
        if not (attempt.converged or self._whole or self._stepper.stopped_by):
            found = self._by_whole_stiffness(before, factor)
        self._whole = hard
        if found is None:
            return attempt
        newton = found.newton_iterations + attempt.newton_iterations
        return dataclasses.replace(
            found, newton_iterations=newton, linear_iterations=attempt.linear_iterations
        )

    def _by_whole_stiffness(self, before: float, factor: float) -> Attempt | None:
        """Seek it by Newton's method with all of the stiffness of pressures; collective."""
        if self._pressures is None:
            return None
        system = self._system
        system.applied.factor = factor
        guess = self._extrapolation.extrapolate(factor, before, system.x[: system.points.n_owned])
        found = self._pressures.find(before, factor, guess)
        if found is not None:
            self._in_vain, self._found, self._rate = 0, factor, None
        return found

    def _by_proximal_steps(self, before: float, factor: float) -> Attempt:
        """Seek it as the module's head says."""
        system, n = self._system, self._system.points.n_owned
        x = system.x[:n].copy()
        system.applied.factor = factor
        newton = linear = solves = anew = resumed = 0
        anchored, last, arrived, leaps = 0.0, np.inf, False, not system.active.viscous
        ceiling, touches = np.inf, system.discretisation.limits_motion
        contacts = system.active.contact_state()
        self._integrator.predicted = self._extrapolation.extrapolate(factor, before, x) - x
        history: list[Iteration] = []
        relaxation = Relaxation(system.points.comm)
        self._friction.begin_step()
        attempt = Attempt(False, 0, 0, 0.0)
        while True:
            force = self._out_of_balance(before, factor, first=solves == 0)
            if not solves:
                self._look_ahead(before, factor)
                anchored, frozen = system.moving_energy_before, system.active.frozen
            history.append(_row(force, attempt if solves else None))
            balanced = arrived and self._balanced(force, last)
            if balanced and self._friction.is_settled():
                self._friction.record_success(factor - before)
                system.moving_energy_before = anchored
                self._in_vain, self._sufficed, self._found = 0, self._integrator.pseudo_dt, factor
                linear += self._learn_rate(x, before, factor)
                return Attempt(True, newton, linear, force, at_roundoff=attempt.at_roundoff)
            lessened = anew + _last_lessened([each.residual for each in history[anew:]])
            words = self._hopeless(solves, lessened, x, arrived=arrived)
            farther = force > WORSE * history[lessened].residual
            if (
                not words
                and arrived
                and farther
                and solves - lessened >= SLIDING
                and self._friction.sliding_message()
            ):
                words = "no equilibrium: proximal steps lead farther off"
            if words:
                break
            if force > WORSE * last:
                self._integrator.pseudo_dt *= SHRINK
            last = force
            if attempt.converged:
                system.active.accept_substep(system.x)
            if balanced:  # but for friction
                anew = len(history)
                longest, leaps = self._integrator.pseudo_dt, not system.active.viscous
                last = self._out_of_balance(before, factor, first=True)
                self._integrator.pseudo_dt = longest
            if self._follows:
                linear += self._take_loads(relaxation, before, factor, first=solves == 0)
            leap = leaps and self._integrator.pseudo_dt > self._careful
            attempt = self._solve(before, factor, LEAP_ITERATIONS if leap else None)
            if self._follows:
                relaxation.record(system.applied.force_at(system.x))
            system.applied.override = system.applied.following = self._integrator.predicted = None
            self._integrator.alternatives = []
            solves += 1
            newton += attempt.newton_iterations
            linear += attempt.linear_iterations
            if attempt.converged:
                arrived = True
                system.active.carry_frames(system.x)  # edges may turn far until they are in equilibrium
                self._careful = self._integrator.pseudo_dt * growth(attempt.newton_iterations)
                self._careful = max(min(self._careful, BELOW * ceiling), self._integrator.pseudo_dt)
                ceiling *= RISE
                self._integrator.pseudo_dt = min(self._careful * (LEAP if leaps else 1.0), self._longest)
            elif leap and resumed < MOST_RESUMED and self._go_on(attempt):
                resumed += 1
            elif leap:  # too far, also where without inertia no preconditioner can be set up
                leaps = self._sufficed == ANY and not arrived and not touches
                self._integrator.pseudo_dt = self._careful
            elif self._stepper.linear_solver_failed or self._stepper.stopped_by:
                break
            else:
                ceiling = self._integrator.pseudo_dt if touches else ceiling
                self._integrator.pseudo_dt *= SHRINK
                leaps = False
        slides = self._friction.record_failure(factor - before) if words and arrived else ""
        if slides:
            words = f"{words}; {slides}"
        self._sufficed = 0.0
        self._in_vain += solves - lessened if arrived else 0
        stuck = attempt.stuck or self._off_balance(before, factor, history, x)
        system.x[:n] = x
        system.points.update_ghosts(system.x)
        system.active.carry_frames(system.x, frozen)
        system.active.restore_contacts(contacts)
        return dataclasses.replace(
            attempt,
            converged=False,
            newton_iterations=newton,
            linear_iterations=linear,
            words=words if slides else attempt.words or words,
            stuck=stuck,
        )

    def _look_ahead(self, before: float, factor: float) -> None:
        """Expect equilibria to go on along the tangent; collective."""
        if before != self._found:
            return
        self._pull = self._system.out_of_balance()[0] / (factor - before)
        if self._rate is not None:
            self._integrator.alternatives = self._extrapolation.tangent_predictions(factor, self._rate)

    def _learn_rate(self, start: Array, before: float, factor: float) -> int:
        """How the equilibrium just found changes as loads do and handles go on from where they were in the
        positions ``start`` (n_owned, 3); linear iterations; collective.
        """
        system, n = self._system, len(start)
        step = factor - before
        moved = np.where(system.prescribed.free, 0.0, system.x[:n] - start)
        (largest,) = system.points.global_max(float(np.abs(moved).max(initial=0.0)))
        pull = self._pull
        if largest > 0.0 and system.discretisation.limits_motion:
            self._rate = None  # with contact guesses are others
            return 0
        if largest > 0.0:
            x, part = system.x.copy(), NUDGE * self._spacing / largest
            here = system.out_of_balance()[0]
            system.x[:n] += part * moved
            system.points.update_ghosts(system.x)
            system.forget_forces()
            pull = pull + (system.out_of_balance()[0] - here) / (part * step)
            system.x[:] = x
            system.forget_forces()
        if self._pressures is None:
            self._rate, spent = self._stepper.tangent(pull)
        else:
            self._rate, spent = self._pressures.tangent(pull, self._pressures.linearise_loads(before, factor))
        if self._rate is not None:
            self._rate += moved / step
        return spent

    def _take_loads(self, relaxation: Relaxation, before: float, factor: float, *, first: bool) -> int:
        """Let the next solve have loads of the present shape, and pressures as they change from there.

        Returns linear iterations.
        """
        system, now = self._system, self._system.applied.force.copy()
        if self._pressures is None:
            system.applied.override = relaxation.relax(now)
            return 0
        loads = system.applied.following = self._pressures.linearise_loads(before, factor)
        way, spent = None, 0
        if system.active.viscous:  # of wind no stiffness is known
            pass
        elif not first:
            way, spent = self._pressures.tangent(system.out_of_balance()[0], loads)
        elif self._integrator.alternatives and self._rate is not None:
            way = (factor - before) * self._rate
        if way is None:
            system.applied.override = relaxation.relax(now)
        else:
            system.applied.override = now + self._pressures.skew_force(loads, way)
        return spent

    def _solve(self, before: float, factor: float, most: int | None) -> Attempt:
        """A proximal step, given up after ``most`` Newton iterations or if one leads far away; collective."""
        snes, convergence = self._stepper.snes, self._stepper.convergence
        allowed = snes.getTolerances()[3]
        snes.setTolerances(max_it=min(allowed, most or allowed))
        convergence.max_displacement = self._size if most else np.inf
        attempt = self._stepper.attempt(before, factor)
        self._stepper.snes.setTolerances(max_it=allowed)
        self._stepper.convergence.max_displacement = np.inf
        return attempt

    def _go_on(self, attempt: Attempt) -> bool:
        """Let the state be the iterate of least energy of a solve that ran out of iterations on its way down,
        if it did; collective.

        Not with contact, whose stencils may be others there, nor where loads would follow.
        """
        system = self._system
        out = attempt.newton_iterations >= LEAP_ITERATIONS
        if not out or self._follows or system.discretisation.limits_motion:
            return False
        lowest = self._stepper.lowest()
        if lowest is None:
            return False
        system.state.set(lowest, np.zeros_like(lowest))
        system.active.carry_frames(system.x)
        return True

    def settle(self, before: float, factor: float) -> EquilibriumReport:
        """Leave the equilibrium just found along its lowest mode while it is unstable; collective."""
        system, n = self._system, self._system.points.n_owned
        anchored = system.moving_energy_before
        newton = linear = followed = 0
        words = ""
        while True:
            lag = self._friction.lag
            with self._examine() as examination:
                found = examination.stability
                if found.stable is not False:
                    break
                mode, way = examination.lowest_mode(), None
                if mode is None:
                    words = "its lowest mode was not found"
                elif self._pressures is not None and self._pressures.skew_part_stabilises(
                    found, mode, factor
                ):
                    found = Stability(reason=NO_POTENTIAL)
                elif examination.is_wrinkle(mode):
                    words = (
                        "sheets without bending wrinkle as finely as the mesh, which is not followed; give a "
                        "bending stiffness"
                    )
                elif followed == MOST_DESCENTS:
                    words = f"its lowest mode was followed {followed} times"
                elif (way := examination.descent(mode)) is None:
                    words = "nothing along its lowest mode has less energy"
                if way is None:
                    break
            x = system.x[:n].copy()
            self._sufficed = 0.0
            system.state.set(x + way, np.zeros_like(x))
            attempt = self.attempt(before, factor)
            newton += attempt.newton_iterations
            linear += attempt.linear_iterations
            if not attempt.converged:
                system.state.set(x, np.zeros_like(x))
                system.begin_step(before, factor)
                system.evaluate_at_start()
                words = "from its lowest mode no other was found"
                break
            followed += 1
        system.moving_energy_before = anchored
        note = _note(found, followed, words)
        if lag > LAG:
            note += "; " if note else ""
            note += f"friction is known to {100.0 * lag:.1g} % of what normal forces allow"
        return EquilibriumReport(found, newton, linear, note)

    def memory(self, factor: float) -> tuple[dict[str, Array], dict[str, Any]]:
        """Arrays (n_owned, 3) and numbers to go on with from the equilibrium at ``factor``; collective."""
        self._extrapolation.record(factor, self._system.x[: self._system.points.n_owned].copy())
        arrays, past = self._extrapolation.memory()
        numbers = {"scale": self._scale, "in_vain": self._in_vain, "sufficed": self._sufficed}
        numbers |= self._friction.memory()
        if self._rate is not None:
            arrays["rate"] = self._rate
        return arrays, numbers | {"extrapolation": past}

    def restore(self, arrays: Mapping[str, Array], memory: Mapping[str, Any], factor: float) -> None:
        """Go on with a memory; an older one is empty."""
        self._scale = float(memory.get("scale", self._scale))
        self._in_vain = int(memory.get("in_vain", self._in_vain))
        self._friction.restore(memory)
        self._sufficed = float(memory.get("sufficed", self._sufficed))
        self._found = factor
        self._rate = np.array(arrays["rate"]) if "rate" in arrays else None
        x = self._system.x[: self._system.points.n_owned].copy()
        self._extrapolation.restore(arrays, memory.get("extrapolation", {}), factor, x)

    @property
    def in_vain(self) -> bool:
        """Whether so much led nowhere since the last equilibrium that a smaller increment is no help."""
        return self._in_vain >= MOST_IN_VAIN or self._friction.in_vain

    def _hopeless(self, solves: int, lessened: int, before: Array, *, arrived: bool) -> str:
        """Why no more proximal steps are taken, or nothing; ``before`` is where they began; collective."""
        if not arrived:
            return "no proximal step was found" if solves >= AT_FIRST else ""
        moved = float(np.abs(self._system.x[: len(before)] - before).max(initial=0.0))
        moved = self._system.points.comm.allreduce(moved, MPI.MAX)
        if moved > FAR * self._size:
            return f"no equilibrium within {moved:.1g} m of the start, as if nothing held the sheet"
        if solves - lessened >= PATIENCE:
            return f"no equilibrium: the last {solves - lessened} of {solves} proximal steps came no nearer"
        return f"no equilibrium within {solves} proximal steps" if solves >= MOST_SOLVES else ""

    def _off_balance(self, before: float, factor: float, history: list[Iteration], x: Array) -> FailedSolve:
        """Where so many proximal steps led that began at positions x."""
        system, n = self._system, self._system.points.n_owned
        system.begin_step(before, factor)
        force, _ = system.out_of_balance()
        goal = x.copy()
        if system.held:
            system.prescribed.targets(before, factor, factor, goal)
        return FailedSolve(
            iterations=tuple(history),
            norm=self._norm(force),
            time=factor,
            velocity=np.zeros_like(x),
            position=system.x[:n].copy(),
            residual=-force,
            forces={"loads": -system.applied.force, "internal": system.applied.force - force},
            prescribed=system.prescribed.mask[:n].copy(),
            goal=goal,
            snes_reason=0,
            ksp_reason=0,
            linear_residuals=np.empty(0),
        )

    def _out_of_balance(self, before: float, factor: float, *, first: bool) -> float:
        """Norm [N] of the force at the present shape; sets Δτ for the first solve of a load step."""
        system = self._system
        system.begin_step(before, factor)
        force, largest = system.out_of_balance()
        norm = self._norm(force)
        if not np.isfinite(norm):  # an obstacle has come to where the sheet is
            return norm
        self._scale = max(self._scale, largest)
        if first and norm > 0.0:
            n = system.points.n_vertices
            fastest = float(np.abs(force[:n] / system.mass[:n, None]).max(initial=0.0))
            if system.points.n_edges_global:  # loads may act on edges alone, which have no mass
                mass = system.points.global_sum(float(system.mass.sum()))[0] / system.points.n_vertices_global
                fastest = max(fastest, float(np.abs(force[n:]).max(initial=0.0)) / mass)
            fastest = system.points.comm.allreduce(fastest, MPI.MAX)
            self._careful = float(np.sqrt(self._spacing / fastest))
            self._longest = LONGEST * self._careful
            sufficed = 0.0 if system.active.viscous else self._sufficed
            self._integrator.pseudo_dt = min(max(self._careful, sufficed), self._longest)
        return norm

    def _balanced(self, force: float, last: float) -> bool:
        """Whether a force of this norm [N] counts as none; ``last`` is that before the last proximal step.

        The floor is the most that round-off may leave: below it forces are lessened as long as they can be.
        """
        if force <= self._tolerances.force_tolerance * self._scale:
            return True
        return LESS * last <= force <= self._floor

    def _norm(self, vector: Array) -> float:
        return float(np.sqrt(self._system.points.comm.allreduce(float(np.vdot(vector, vector)))))


def _note(found: Stability, followed: int, words: str) -> str:
    """What the user should know of an equilibrium's stability, or nothing."""
    if found.stable is None:
        return f"whether the equilibrium is stable is not known: {found.reason}"
    if not found.stable:
        ways = "1 way" if found.negative == 1 else f"{found.negative} ways"
        return f"the equilibrium is unstable, it gives way in {ways} (negative pivots): {words}"
    notes = []
    if followed:
        times = "once" if followed == 1 else f"{followed} times"
        notes.append(
            f"the first equilibrium was unstable; its lowest mode was followed {times}, to a stable one"
        )
    if found.neutral:
        notes.append(f"the equilibrium is neutral: nothing resists {found.neutral} motions (neutral pivots)")
    return "; ".join(notes)


def _row(force: float, attempt: Attempt | None) -> Iteration:
    """The out-of-balance force [N] after a proximal step, or before the first."""
    return Iteration(force, attempt.linear_iterations if attempt else 0, 0, 1.0 if attempt else None)


def _last_lessened(forces: list[float]) -> int:
    """Which was the last of these forces that was markedly less than all before."""
    last, least = 0, np.inf
    for number, force in enumerate(forces):
        if force < LESS * least:
            last, least = number, force
    return last


def growth(iterations: int) -> float:
    """Factor on Δτ after a solve of so many Newton iterations."""
    if iterations <= EASY:
        return GROW_FAST
    return GROW if iterations <= FAIR else 1.0
