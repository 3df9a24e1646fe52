"""Balances of energy and momentum of a time step, computed from its two states and the terms alone.

Backward Euler satisfies an energy identity; with the masses M, the elastic energy E and x' − x = Δt v' = Δx::

    Δ(kinetic + potential) = −½ ‖Δv‖²_M − Δt v'ᵀ D v' + bracket + work
    bracket = ∫₀¹ ∇E(x + s Δx)·Δx ds − ∇E(x')·Δx

The left side consists of energies and the right side of forces, so that forces which are not the gradient
of their energy violate it, as does a step that was not solved. The integral is exact for the membrane (its
energy is a quartic along a line). For hinges and contact its panels are halved where it has not converged;
where hinges jump, as their model does beyond 180°, it is replaced by the difference of their energies.

Every step leaves a residual r on the free coordinates. The solver promises ‖r‖ ≤ force tolerance × largest
force, or the round-off floor; this is judged separately. Given r, the energy identity may be violated by
‖r‖ ‖Δx‖ plus the round-off of its terms, and the balance of momentum by √V ‖r‖ Δt. These are the tolerances;
none of them is chosen.

The stage of any other integrator solves M v̇ + ∇E + D v = f. It is judged like backward Euler by the residual
on the free coordinates and by the sum of the internal forces. There is no energy identity, but the work of
the elastic forces along a step must equal the change of the elastic energy.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array
from lyra_petsc.experiments.case import StoredArray, Verdict
from lyra_petsc.show.report.document import short
from lyra_petsc.stepping.energy_guard import LARGEST_SUM
from lyra_petsc.stepping.newton.roundoff import residual_roundoff
from lyra_petsc.stepping.simulation import SteppedScene, StepReport
from lyra_petsc.stepping.state import resized
from lyra_petsc.terms.bending.hinge import Bending
from lyra_petsc.terms.bending.midedge import MidEdge
from lyra_petsc.terms.membrane import Membrane
from lyra_petsc.terms.registry import Role
from lyra_petsc.terms.stretch import SOFTENS_BELOW
from lyra_petsc.terms.term import Elastic, UpcomingStep

EPSILON = 10.0 * float(np.finfo(np.float64).eps)
"""Relative round-off of a sum, as in `residual_roundoff`."""

CONTACT_PANELS, HALVED_PANELS, MAX_PANELS = 16, 128, 1024
"""Fewest panels of the integral for contact, which has at least one for each half gap, as a barrier is as
wide as its gap; most panels that are halved where it has not converged; most at the start."""

TURN_SAMPLES, LARGEST_TURN = 9, 1.0
"""Samples of a step, and the change of angle [rad] between two samples beyond which a hinge may have jumped.
A hinge that passes 180° changes its energy without a force; one whose triangle is inverted in its plane loses
its energy and regains it within a short displacement."""


Terms = Mapping[Elastic, Any]
"""Terms with their data that are frozen for the step."""


def gradient(terms: Terms, x: Array) -> Array:
    """Gradient (n_local, 3) [N] of the energy of the terms at x (n_local, 3)."""
    out = np.zeros_like(x)
    for term, frozen in terms.items():
        term.add_gradient(x, frozen, out)
    return out


def energy(terms: Terms, x: Array) -> float:
    """Energy [J] of this rank's elements."""
    return sum(float(term.energies(x, frozen).sum()) for term, frozen in terms.items())


def force_work(
    comm: MPI.Comm, n: int, terms: Terms, start_frames: Terms, x0: Array, dx: Array, tolerance: float
) -> tuple[float, bool]:
    """∫₀¹ ∇E(x0 + s Δx)·Δx ds [J], and whether energy differences replace a part of it; collective.

    Exact for the membrane, whose energy is a quartic along a line; for other terms refined to convergence.

    Parameters
    ----------
    n : int
        Owned vertices of this rank.
    terms : mapping of Elastic to its data frozen for the step
    start_frames : mapping of Elastic
        Frames at the start of the step of the terms whose frames turned within it.
    x0, dx : (n_local, 3)
        Positions at the start of the step and displacements [m].
    tolerance : float
        Error of the integral [J] that is accepted.
    """
    from scipy.integrate import fixed_quad, quad_vec

    membrane: Terms = {term: frozen for term, frozen in terms.items() if isinstance(term, Membrane)}
    contact = {term: frozen for term, frozen in terms.items() if term.registration.neighbours}
    hinges = {term: frozen for term, frozen in terms.items() if term not in membrane and term not in contact}

    def power(part: Terms, s: float) -> float:
        return float(comm.allreduce(float(np.vdot(gradient(part, x0 + s * dx)[:n], dx[:n]))))

    def refined(part: Terms, panels: int) -> float | None:
        """The integral for some terms, with panels halved where needed; None if it does not converge."""
        if panels > MAX_PANELS:
            return None
        value, _, info = quad_vec(
            lambda s: power(part, s),
            0.0,
            1.0,
            points=np.linspace(0.0, 1.0, panels + 1)[1:-1],
            quadrature="gk15",
            epsabs=tolerance,
            epsrel=EPSILON,
            limit=panels + HALVED_PANELS,
            full_output=True,
        )
        return float(value) if info.success else None

    along_membrane, _ = fixed_quad(lambda at: np.array([power(membrane, s) for s in at]), 0.0, 1.0, n=2)
    value, by_energies = float(along_membrane), False
    turn = math.inf if start_frames else _largest_turn(hinges, x0, dx)
    smooth = comm.allreduce(turn, op=MPI.MAX) < LARGEST_TURN
    largest_dx, skin = largest(comm, dx[:n]), min((term.skin for term in contact), default=0.0)
    panels = max(CONTACT_PANELS, math.ceil(largest_dx / skin) if skin > 0.0 else 0)
    for part, refine, first in ((hinges, smooth, 1), (contact, True, panels)):
        if part:
            integral = refined(part, first) if refine else None
            if integral is None:
                at_start = {term: start_frames.get(term, frozen) for term, frozen in part.items()}
                change = energy(part, x0 + dx) - energy(at_start, x0)
                integral, by_energies = float(comm.allreduce(change)), True
            value += integral
    return value, by_energies


def _largest_turn(terms: Terms, x0: Array, dx: Array) -> float:
    """Largest change [rad] of a hinge's angle between two of `TURN_SAMPLES` points of the displacement."""
    turn = 0.0
    for term in terms:
        if isinstance(term, Bending):
            before = term.angles(x0)
            for s in np.linspace(0.0, 1.0, TURN_SAMPLES)[1:]:
                now = term.angles(x0 + s * dx)
                turn = max(turn, float(np.abs(now - before).max(initial=0.0)))
                before = now
    return turn


@dataclass(frozen=True, kw_only=True)
class StepBalance:
    """The balances of one step in J, N, kg m/s and kg m²/s, the same on every rank.

    Attributes
    ----------
    change : float
        Change of kinetic + potential energy in the step.
    numerical, viscous : float
        ½ ‖Δv‖²_M and Δt v'ᵀ D v'.
    bracket, work : float
        See the module.
    defect, tolerance : float
        Left minus right side of the energy identity, and its tolerance.
    residual, promised, floor : float
        Norm of the residual on free coordinates, the norm that the solver promised, and the round-off floor.
    driving : float
        Norm on free coordinates of the largest kind of force, internal forces excluded.
    displacement : float
        Displacement by these forces [m]: largest change of a free coordinate beyond Δt v.
    momentum, momentum_tolerance : float
        Largest component of Δ(Σ m v) − Δt Σ external forces, and its tolerance.
    angular, angular_tolerance : float
        Largest component of Σ (x' − centre) × (m Δv) − Δt Σ torques, and its tolerance.
    hinges_jumped : bool
        Hinges turned too far, or contacts moved much farther than the gap, for their forces to be integrated;
        their part of the bracket is computed from energies.
    """

    change: float
    numerical: float = 0.0
    viscous: float = 0.0
    bracket: float
    work: float = 0.0
    defect: float
    tolerance: float
    residual: float
    promised: float
    floor: float
    driving: float
    displacement: float
    momentum: float
    momentum_tolerance: float
    angular: float = 0.0
    angular_tolerance: float = 0.0
    jumped: bool = False

    @property
    def energy_exchanged(self) -> float:
        """Sum of the sizes of all terms of the energy identity [J]."""
        return abs(self.change) + self.numerical + abs(self.viscous) + abs(self.bracket) + abs(self.work)


def largest(comm: MPI.Comm, values: Array) -> float:
    """Largest absolute value on all ranks."""
    return float(comm.allreduce(float(np.abs(values).max(initial=0.0)), op=MPI.MAX))


def _acts_from_outside(term: Elastic) -> bool:
    """Whether a term of the sheet's energy also exerts external forces: clamps, contact with obstacles."""
    return term.registration.moving or term.registration.neighbours


class BalanceRecorder:
    """Computes the balance of each step of backward Euler; collective.

    Parameters
    ----------
    simulation : SteppedScene
        Before its first step; `record_state` must be called before every step.
    """

    def __init__(self, simulation: SteppedScene) -> None:
        self._simulation = simulation
        self._system = simulation.problem.system
        elastic = self._system.active.elastic
        self._handle_terms = [term for term in elastic if term.registration.role is Role.CONSTRAINT]
        self._sheet_terms = [term for term in elastic if term not in self._handle_terms]
        self.record_state()

    @property
    def _sheet(self) -> Terms:
        """The energies of the sheet, with the present targets of clamps."""
        return {term: self._system.active.frozen[term] for term in self._sheet_terms}

    @property
    def _springs(self) -> Terms:
        """The springs of handles."""
        return {term: self._system.active.frozen[term] for term in self._handle_terms}

    def record_state(self) -> None:
        """Store the state and its energy, with the targets that clamps have at the end of the last step."""
        system = self._system
        self._x, self._v = system.x.copy(), system.v.copy()
        self._energy = energy(self._sheet, system.x)
        self._frames: Terms = {term: term.frames for term in self._sheet_terms if isinstance(term, MidEdge)}

    @property
    def _solved(self) -> Array:
        """Velocities (n_local, 3) [m/s] that solve the equations of the step, before impact damping."""
        return self._system.v if self._system.contact_impulses is None else self._system.evaluated[1]

    def _update_start_ghosts(self) -> None:
        """Extend the positions at the start of the step to the present ghosts of contact; collective."""
        layout = self._system.points
        self._x = resized(self._x, layout.n_owned, layout.n_local)
        layout.update_ghosts(self._x)

    @property
    def _start_frames(self) -> Terms:
        """Frames at the start of the step of the terms whose frames have turned since."""
        now = self._system.active.frozen
        return {term: frames for term, frames in self._frames.items() if now[term] is not frames}

    def balance(self, report: StepReport) -> StepBalance:
        """The balance of the step just accepted, which started from the state recorded last."""
        system, comm = self._system, self._system.points.comm
        n, dt = system.points.n_owned, report.dt
        self._update_start_ghosts()
        x0, v0, x1, v1 = self._x, self._v, system.x, self._solved
        dx, dv = x1 - x0, v1[:n] - v0[:n]
        free = ~system.prescribed.mask[:n]
        parts = self._force_terms(report, dv / dt)
        reaction = self._simulation.energy_balance.reaction
        if system.contact_impulses is not None:  # impact damping acts after the equations are solved
            at = system.prescribed.indices
            reaction.put(at, reaction.take(at) - system.contact_impulses.handle_force)
        weight = self._weight(report)
        owned_dx = dx[:n]
        outside = -parts["loads"] + reaction
        for name in ("springs", "wind"):
            outside = outside - parts[name]
        # clamps and obstacles store energy, but exert external forces as they are fixed in space
        external = {term: frozen for term, frozen in self._sheet.items() if _acts_from_outside(term)}
        external_gradient = gradient(external, x1)[:n]
        external_damping = self._damping(external, v1)[:n]
        end_energy, start_energy = energy(self._sheet, x1), energy({**self._sheet, **self._start_frames}, x0)
        target_work = start_energy - self._energy
        mass, size_of_g = system.mass[:, None], float(np.linalg.norm(self._simulation.scene.gravity or 0.0))
        (kinetic0, kinetic1, elastic, turn, fallen0, fallen1, numerical, viscous, inner, outer,
         free_dx, all_dx, energy_noise, forces, powers, heights) = system.points.global_sum(
            0.5 * float(np.sum(mass * v0[:n] ** 2)),
            0.5 * float(np.sum(mass * v1[:n] ** 2)),
            end_energy - start_energy,
            target_work,
            sum(load.potential(x0) for load in system.active.loads),
            sum(load.potential(x1) for load in system.active.loads),
            0.5 * float(np.sum(mass * dv**2)),
            float(np.vdot(parts["damping"], owned_dx)),
            float(np.vdot(parts["internal"], owned_dx)),
            float(np.vdot(outside - weight, owned_dx)),
            float(np.sum(owned_dx**2, where=free)),
            float(np.sum(owned_dx**2)),
            self._energy_roundoff(x1) + self._energy_roundoff(x0),
            float(sum(np.abs(part).sum() for part in parts.values())),
            float(sum(np.abs(part * owned_dx).sum() for part in parts.values())),
            float(np.abs(mass * np.abs(system.x[:n])).sum()) * size_of_g,
        ).tolist()  # fmt: skip
        reach = largest(comm, x1)
        left = self._residual_norms(parts, reach, dt)
        solved = left["residual"] * np.sqrt(free_dx) + left["floor"] * np.sqrt(all_dx)
        # positions are rounded: x' − x equals Δt v' only to the last digit of x
        noise = EPSILON * (energy_noise + powers + forces * reach + kinetic0 + kinetic1 + heights)
        tolerance = float(solved + noise)
        along, jumped = force_work(comm, n, self._sheet, self._start_frames, x0, dx, 0.1 * tolerance)
        bracket = along - inner
        change = kinetic1 - kinetic0 + elastic + turn + fallen1 - fallen0
        work = outer + turn
        defect = change - (-numerical - viscous + bracket + work)
        defects = mass * dv - dt * (outside - external_gradient - external_damping)
        unsolved = left["residual"] + left["floor"]
        damped_defects = defects + dt * (parts["damping"] - external_damping)
        return StepBalance(
            change=change,
            numerical=numerical,
            viscous=viscous,
            bracket=bracket,
            work=work,
            defect=defect,
            tolerance=tolerance,
            jumped=jumped,
            **left,
            **self._momentum_defects(defects, damped_defects, dt, unsolved, forces, reach),
        )

    def _residual_norms(self, parts: Mapping[str, Array], reach: float, dt: float) -> dict[str, float]:
        """Norms [N] of the residual, its promised bound, its round-off floor and the driving forces, and the
        displacement [m] by these; keys are fields of `StepBalance`."""
        system, simulation = self._system, self._simulation
        free = ~system.prescribed.mask[: system.points.n_owned]
        everything = [*parts.values(), np.asarray(sum(parts.values()))]
        squares = system.points.global_sum(*(float(np.sum(part**2, where=free)) for part in everything))
        *each, residual = np.sqrt(squares).tolist()
        floor = residual_roundoff(system, max(reach, simulation.problem.whole.largest_coordinate))
        n = len(free)
        displacement = system.x[:n] - self._x[:n] - dt * self._v[:n]
        return {
            "residual": residual,
            "promised": max(simulation.scene.solver.force_tolerance * max(each), floor),
            "floor": floor,
            "driving": max(norm for name, norm in zip(parts, each, strict=True) if name != "internal"),
            "displacement": largest(system.points.comm, np.where(free, displacement, 0.0)),
        }

    # -- parts ---------------------------------------------------------------------------------------

    def _force_terms(self, report: StepReport, rate: Array) -> dict[str, Array]:
        """The terms of the residual F, each (n_owned, 3) [N], evaluated again; loads with their sign in F."""
        system = self._system
        n, x1, v1 = system.points.n_owned, system.x, self._solved
        force = np.zeros((system.points.n_local, 3))
        for load in system.active.loads:
            load.add_force(self._x, report.time - report.dt, report.time, force)
        wind = np.zeros_like(force)
        for term in system.active.viscous:
            step = UpcomingStep(system.t0, system.t1, system.t0, self._x, system.reference.at)
            term.add_gradient(v1, term.freeze(step), wind)
        return {
            "inertia": system.mass[:, None] * rate,
            "internal": gradient(self._sheet, x1)[:n],
            "springs": gradient(self._springs, x1)[:n],
            "damping": self._damping(self._sheet, v1)[:n],
            "wind": wind[:n],
            "loads": -force[:n],
        }

    def _damping(self, terms: Terms, v: Array) -> Array:
        """D v (n_owned, 3) [N], assembled again with the stiffness at the start of the step."""
        system = self._system
        rows = system.discretisation.fixed
        values = rows.zeros()
        for term, frozen in terms.items():
            gamma = term.elements.data.get("damping")
            if term.registration.damped and gamma is not None and np.any(gamma):
                at_start = system.damping.frozen.get(term, frozen)
                rows.add_stiffness(term, self._x, at_start, 1.0, gamma, values)
        return rows.product(values, v)

    def _weight(self, report: StepReport) -> Array:
        """Forces (n_owned, 3) [N] of loads whose work is included in the potential energy."""
        out = np.zeros((self._system.points.n_local, 3))
        for load in self._system.active.loads:
            if load.registration.energy:
                load.add_force(self._x, report.time - report.dt, report.time, out)
        return out[: self._system.points.n_owned]

    def _energy_roundoff(self, x: Array) -> float:
        """Sum [J] over this rank's elements; times the machine epsilon it is the round-off of the energies.

        An energy E = ½ k s² whose strain s is a difference of coordinates has the error √(2 E S) ε, where S
        is the energy at a strain of order one.
        """
        reach = float(np.abs(x).max(initial=0.0))
        amount = 0.0
        for term, frozen in self._sheet.items():
            each = term.energies(x, frozen)
            scale = reach * term.force_scale(reach)[: term.n_owned]
            amount += float(np.sum(np.abs(each) + np.sqrt(2.0 * np.abs(each) * scale)))
            amount += EPSILON * float(np.sum(scale))
        return amount

    def _momentum_defects(
        self, defects: Array, damped: Array, dt: float, left: float, forces: float, reach: float
    ) -> dict[str, float]:
        """Defects of linear and angular momentum and their tolerances.

        ``defects`` (n_owned, 3) is m Δv − Δt × external forces; ``damped`` also subtracts damping forces:
        frozen with the geometry at the start, their sum vanishes, but not their moment.
        """
        system, comm = self._system, self._system.points.comm
        n, count = system.points.n_owned, system.points.n_global
        x, mass = system.x[:n], system.mass[:, None]
        centre = comm.allreduce(np.append((mass * x).sum(axis=0), mass.sum()))
        arms = x - centre[:3] / centre[3]
        arms = arms[: system.points.n_vertices]
        moment = np.cross(arms, damped[: len(arms)]).sum(axis=0)
        for term, frozen in self._sheet.items():
            if isinstance(term, MidEdge):
                own = np.flatnonzero(term.edge_indices < 3 * n)
                moment += term.moment(damped.ravel()[term.edge_indices[own]], own, system.x, frozen)
        sums = comm.allreduce(np.concatenate([defects[: len(arms)].sum(axis=0), moment]))
        longest = float(comm.allreduce(float(np.square(arms).sum())))
        noise = EPSILON * forces * dt
        linear = dt * left * np.sqrt(count) + noise
        angular = dt * left * np.sqrt(longest) + noise * reach
        return {
            "momentum": float(np.abs(sums[:3]).max()),
            "momentum_tolerance": float(linear),
            "angular": float(np.abs(sums[3:]).max()),
            "angular_tolerance": float(angular),
        }


class StageBalanceRecorder(BalanceRecorder):
    """Computes the balances that hold for steps of other integrators; collective. See `BalanceRecorder`."""

    def balance(self, report: StepReport) -> StepBalance:
        """The balance of the step just accepted: ``change`` of the elastic energy, ``bracket`` the work of
        the elastic forces; ``numerical``, ``viscous`` and ``work`` are not known."""
        system, comm = self._system, self._system.points.comm
        n, dt = system.points.n_owned, report.dt
        self._update_start_ghosts()
        x0, x1 = self._x, system.x
        # moving targets are at the end of the step by now; damping needs the frames of the step
        system.active.move_targets(self._at(system.t0 + system.stage.offset))
        parts = dict(system.forces_at_stage())
        ended = self._at(system.t1)
        frozen = {term: term.freeze(ended) for term in system.active.elastic}
        system.active.frozen = system.active.frozen | frozen
        total = np.asarray(sum(parts.values()))
        defects = total - self._simulation.energy_balance.reaction
        if not any(_acts_from_outside(term) for term in self._sheet):
            # external forces of such terms cannot be separated from internal ones here
            defects = defects - parts["internal"] - parts.get("damping", 0.0)
        change, noise, forces, all_dx, *sums = system.points.global_sum(
            energy(self._sheet, x1) - energy({**self._sheet, **self._start_frames}, x0),
            self._energy_roundoff(x1) + self._energy_roundoff(x0),
            float(sum(np.abs(part).sum() for part in parts.values())),
            float(np.sum((x1 - x0)[:n] ** 2)),
            *defects[: system.points.n_vertices].sum(axis=0),
        ).tolist()
        reach = largest(comm, x1)
        left = self._residual_norms(parts, reach, dt)
        unsolved = (left["residual"] + left["floor"]) * math.sqrt(system.points.n_global)
        tolerance = EPSILON * (noise + forces * reach) + left["floor"] * math.sqrt(all_dx)
        along, jumped = force_work(comm, n, self._sheet, self._start_frames, x0, x1 - x0, 0.1 * tolerance)
        return StepBalance(
            change=change,
            bracket=along,
            defect=change - along,
            tolerance=tolerance,
            momentum=dt * max(map(abs, sums)),
            momentum_tolerance=dt * (unsolved + EPSILON * forces),
            jumped=jumped,
            **left,
        )

    def _at(self, time: float) -> UpcomingStep:
        """The step as terms receive it, at a time [s] within it."""
        system = self._system
        return UpcomingStep(system.t0, system.t1, time, system.x, system.reference.at)


@dataclass
class RunRecord:
    """All steps of a case, the same on every rank.

    Attributes
    ----------
    planned : int
        Number of steps at the nominal Δt.
    nominal : float
        Nominal Δt [s].
    end : float
        End time [s].
    start_energy : float
        Kinetic + potential energy at the start [J].
    reports : list of StepReport
        One per accepted step.
    balances : list of StepBalance
        One per accepted step; empty for the semi-implicit method, which has no such balance.
    energies : list of float
        Kinetic + potential energy after each step [J].
    observed : list
        Results of the ``observe`` function of the case, at the start and after each step.
    notes : list of str
        Notes of the simulation.
    stop_reason : str
        Why the case did not reach its end; empty if it did.
    integrator : str
    balance : dict
        Energy balance of the whole run, as in summary.json; empty if nothing ran.
    cpu_seconds : list of float
        CPU time of each step [s], the maximum over ranks.
    last : (V, 3) array or None
        Positions [m] after the last step, on rank 0; None if they were not gathered or have been freed.
    triangles : (F, 3) array or None
        Vertices of the triangles, on rank 0.
    """

    planned: int = 0
    nominal: float = math.nan
    end: float = math.nan
    start_energy: float = math.nan
    reports: list[StepReport] = field(default_factory=list)
    balances: list[StepBalance] = field(default_factory=list)
    energies: list[float] = field(default_factory=list)
    observed: list[Any] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    stop_reason: str = ""
    integrator: str = "beuler"
    balance: dict[str, Any] = field(default_factory=dict)
    cpu_seconds: list[float] = field(default_factory=list)
    last: StoredArray | None = None
    triangles: StoredArray | None = None

    @property
    def newton(self) -> list[int]:
        """Newton iterations of each step, including its rejected attempts."""
        return [report.newton_iterations for report in self.reports]

    @property
    def linear(self) -> int:
        """Linear iterations of all steps."""
        return sum(report.linear_iterations for report in self.reports)

    @property
    def rejected(self) -> int:
        """Number of attempts at steps that failed or were too inaccurate."""
        return sum(report.rejected for report in self.reports)

    @property
    def smallest_step(self) -> float:
        """Smallest Δt [s] of an accepted step; NaN without any."""
        return min((report.dt for report in self.reports), default=math.nan)

    @property
    def stretches(self) -> tuple[float, float]:
        """Smallest and largest principal stretch of all steps; NaN without a step."""
        if not self.reports:
            return math.nan, math.nan
        return (
            min(report.smallest_stretch for report in self.reports),
            max(report.largest_stretch for report in self.reports),
        )

    @property
    def median_seconds(self) -> float:
        """Median wall time of a step [s]; NaN without any."""
        return statistics.median(r.wall_seconds for r in self.reports) if self.reports else math.nan

    @property
    def median_cpu(self) -> float:
        """Median CPU time of a step [s]; NaN without any."""
        return statistics.median(self.cpu_seconds) if self.cpu_seconds else math.nan

    @property
    def median_newton(self) -> float:
        """Median Newton iterations of a step; NaN without any."""
        return float(statistics.median(self.newton)) if self.reports else math.nan

    @property
    def dissipation(self) -> float:
        """Numerical dissipation over the largest energy exchanged; NaN without a step."""
        return float(self.balance.get("numerical_dissipation", math.nan)) if self.reports else math.nan

    @property
    def times(self) -> list[float]:
        """Times [s] at the ends of steps."""
        return [report.time for report in self.reports]


NEGLIGIBLE = 0.1
"""Part of the driving forces below which a residual is negligible; the same for the displacements by both."""

SMALL_DISSIPATION = 0.05
"""Numerical dissipation over the largest energy exchanged up to which a motion is called right."""

MAX_DISSIPATION = 0.5
"""The same ratio beyond which a run fails if its steps have no other balance (semi-implicit)."""

NEWTON_MEDIAN, NEWTON_MAX = 10, 30
"""Allowed Newton iterations per step of a stiff sheet, median and maximum."""

MAX_RATIO = 5.0
"""Allowed median time per step of a stiff sheet over that of the base scene."""


def judge_convergence(record: RunRecord) -> Verdict:
    """Whether every step was solved and the end was reached."""
    if record.stop_reason:
        return Verdict(False, f"{len(record.reports)} steps, then: {record.stop_reason}")
    text = f"all {len(record.reports)} steps"
    if record.rejected:
        smallest = short(record.smallest_step)
        text += (
            f", {record.rejected} attempts rejected, smallest Δt {smallest} s of {short(record.nominal)} s"
        )
    return Verdict(bool(record.reports), text)


def judge_equations(record: RunRecord) -> Verdict:
    """Whether the residual, computed again, is as small as the solver promised in every step."""
    number, worst = _worst_step(record, lambda b: ratio(b.residual, b.promised + b.floor))
    at_floor = sum(balance.promised <= balance.floor for balance in record.balances)
    text = (
        f"worst in step {number}: {short(worst.residual)} N left on the free vertices, "
        f"{short(worst.promised)} N promised"
    )
    if at_floor:
        text += f"; in {at_floor} steps that is the floor of round-off"
    return Verdict(worst.residual <= worst.promised + worst.floor, text)


def judge_resolution(record: RunRecord) -> Verdict:
    """Whether the residual is far below the driving forces, or the displacement that it causes is small.

    At the round-off floor the residual of stiff forces may be as large as the weight without any effect.
    """
    steps = zip(record.balances, record.reports, strict=True)
    by_force = [ratio(balance.residual, NEGLIGIBLE * balance.driving) for balance in record.balances]
    by_displacement = [
        ratio(report.remaining, NEGLIGIBLE * balance.displacement) for balance, report in steps
    ]
    number = max(range(len(by_force)), key=lambda i: min(by_force[i], by_displacement[i]))
    worst, last = record.balances[number], record.reports[number].remaining
    text = (
        f"worst in step {number + 1}: {short(worst.residual)} N left, {short(worst.driving)} N move the sheet"
    )
    if worst.promised <= worst.floor:
        text += "; round-off at this stiffness allows no better"
    if by_displacement[number] < by_force[number]:
        text += (
            f"; they still move it by {short(last)} m, and the step's forces by {short(worst.displacement)} m"
        )
    return Verdict(min(by_force[number], by_displacement[number]) <= 1.0, text)


def judge_energy(record: RunRecord) -> Verdict:
    """Whether the energy identity of backward Euler holds in every step within its tolerance.

    For other integrators: whether the work of elastic forces equals the change of their energy.
    """
    number, worst = _worst_step(record, lambda b: ratio(abs(b.defect), b.tolerance))
    text = (
        f"worst in step {number}: off by {short(abs(worst.defect))} J, tolerance {short(worst.tolerance)} J, "
        f"{short(worst.energy_exchanged)} J turned over"
    )
    jumped = sum(balance.jumped for balance in record.balances)
    if jumped:
        text += (
            f"; in {jumped} steps hinges turned too far or jumped, or contact came from too far, and "
            "count by their energies"
        )
    return Verdict(abs(worst.defect) <= worst.tolerance, text)


def judge_gain(record: RunRecord) -> Verdict:
    """Whether the energy grows by no more than the work where the bracket of the identity is not positive."""
    steps = [
        (number, balance)
        for number, balance in enumerate(record.balances, 1)
        if not balance.bracket > balance.tolerance
    ]
    with_gain = len(record.balances) - len(steps)
    about_gain = f"; in {with_gain} steps buckling could feed energy in" if with_gain else ""
    if not steps:
        return Verdict(True, f"not to be judged{about_gain}")
    number, worst = max(steps, key=lambda step: ratio(_gain(step[1]), step[1].tolerance))
    gain = _gain(worst)
    if gain > worst.tolerance:
        text = f"step {number} gained {short(gain)} J beyond the work, tolerance {short(worst.tolerance)} J"
        return Verdict(False, text + about_gain)
    negative = [n for n, b in enumerate(record.balances, 1) if -b.viscous > b.tolerance]
    if negative:
        return Verdict(False, f"damping fed energy into step {negative[0]}{about_gain}")
    return Verdict(True, f"none in the {len(steps)} steps where the elastic energy is convex{about_gain}")


def judge_run(record: RunRecord) -> Verdict:
    """Whether the whole run gains no energy and, if semi-implicit, does not lose most of it."""
    gained, dissipation = (float(record.balance[f"numerical_{what}"]) for what in ("gain", "dissipation"))
    net = gained - dissipation
    text = (
        f"{100.0 * dissipation:.2g} % of the largest energy at work lost to the integrator, "
        f"{100.0 * gained:.2g} % made by it"
    )
    if record.balance["repeated"]:
        text += f", {record.balance['repeated']} attempts repeated for it"
    good = net <= LARGEST_SUM and (record.integrator != "semi-implicit" or dissipation <= MAX_DISSIPATION)
    if good and dissipation > SMALL_DISSIPATION:
        text += "; solved, but a smaller Δt moves otherwise"
    return Verdict(good, text)


def judge_momentum(record: RunRecord) -> Verdict:
    """Whether linear and angular momentum change by external forces only: internal forces sum to zero."""
    at, line = _worst_step(record, lambda b: ratio(b.momentum, b.momentum_tolerance))
    turn_step, turn = _worst_step(record, lambda b: ratio(b.angular, b.angular_tolerance))
    text = f"worst in step {at}: {short(line.momentum)} N s, tolerance {short(line.momentum_tolerance)} N s"
    if turn.angular_tolerance:
        text += (
            f"; angular in step {turn_step}: {short(turn.angular)} N m s, "
            f"tolerance {short(turn.angular_tolerance)} N m s"
        )
    good = line.momentum <= line.momentum_tolerance and turn.angular <= turn.angular_tolerance
    return Verdict(good, text)


def judge_softening(record: RunRecord) -> Verdict:
    """Whether a triangle that is compressed into the softening range of its model was reported."""
    smallest = record.stretches[0]
    if not smallest < SOFTENS_BELOW:
        return Verdict(True, f"no triangle below {SOFTENS_BELOW:.3f} of its length")
    notes = [note for note in record.notes if "St. Venant-Kirchhoff model softens" in note]
    text = f"down to {short(smallest)} of its length, " + (
        "which is said" if notes else "and NOTHING was said"
    )
    return Verdict(bool(notes), text)


def judge_speed(record: RunRecord, wall_ratio: float, cpu_ratio: float) -> Verdict:
    """Whether steps take few iterations, and a time comparable to that of the base scene.

    ``wall_ratio`` and ``cpu_ratio`` are ratios of median wall and CPU times; one of them suffices, as wall
    times mean little on a machine with other load.
    """
    median, worst = record.median_newton, max(record.newton, default=0)
    good = median <= NEWTON_MEDIAN and worst <= NEWTON_MAX and min(wall_ratio, cpu_ratio) <= MAX_RATIO
    text = (
        f"Newton iterations {short(median)} in the median and {worst} at worst "
        f"({NEWTON_MEDIAN} and {NEWTON_MAX} allowed), {short(wall_ratio)} times the base's wall time, "
        f"{short(cpu_ratio)} times its CPU time ({MAX_RATIO:g} allowed)"
    )
    return Verdict(good and not record.stop_reason, text)


def judge_physics(record: RunRecord) -> dict[str, Verdict]:
    """All verdicts that apply to any case, by name."""
    verdicts = {"converged": judge_convergence(record)}
    if record.balances:
        verdicts |= {
            "equations": judge_equations(record),
            "resolved": judge_resolution(record),
            "energy": judge_energy(record),
            "momentum": judge_momentum(record),
        }
        if record.integrator == "beuler":
            verdicts["no gain"] = judge_gain(record)
    if record.reports:
        verdicts["softening"] = judge_softening(record)
        if record.balance:
            verdicts["whole run"] = judge_run(record)
    return verdicts


def _gain(balance: StepBalance) -> float:
    return balance.change - balance.work


def ratio(amount: float, tolerance: float) -> float:
    """The amount over its tolerance; infinite if one of them is NaN."""
    if math.isnan(amount) or math.isnan(tolerance):
        return math.inf
    return amount / tolerance if tolerance > 0.0 else math.copysign(math.inf, amount) if amount else 0.0


def _worst_step(record: RunRecord, measure: Callable[[StepBalance], float]) -> tuple[int, StepBalance]:
    """Number, counted from 1, and balance of the step with the largest ``measure``."""
    number = max(range(len(record.balances)), key=lambda i: measure(record.balances[i]))
    return number + 1, record.balances[number]
