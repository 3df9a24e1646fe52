"""What a step did to energy and momenta, from its two states and the terms alone.

For backward Euler the energy identity, with the masses M, the elastic energy E and x' − x = Δt v' =: Δx::

    Δ(kinetic + potential) = −½ ‖Δv‖²_M − Δt v'ᵀ D v' + bracket + work
    bracket = ∫₀¹ ∇E(x + s Δx)·Δx ds − ∇E(x')·Δx

The left side is made of energies and the right of forces, so that forces which are not the gradient of
their energy break it as surely as a step that was not solved. The integral of the membrane is exact (its
energy is a quartic along a line); that of the hinges is refined until it stands, and where hinges jump,
which their model does beyond 180°, it is replaced by their energies' difference.

Every step leaves a residual r on the free coordinates, of which the solver promises ‖r‖ ≤ force tolerance
× forces at work, or the floor of round-off: that is judged for itself. With r as it is, the identity may
be off by no more than ‖r‖ ‖Δx‖ and the round-off of its own summands, and the balance of momentum by √V
‖r‖ Δt: these are the tolerances, none is chosen.

The stage of any other integrator solves M v̇ + ∇E + D v = f, and that is judged as for backward Euler: by
what is left on the free coordinates, and by what the forces within the sheet add up to. There is no
identity for its energies; but along the way of a step the elastic forces must add up to the change of the
elastic energy.
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
from lyra_petsc.stepping.roundoff import residual_roundoff
from lyra_petsc.stepping.simulation import SteppedScene, StepReport
from lyra_petsc.stepping.state import resized
from lyra_petsc.terms.bending import Bending
from lyra_petsc.terms.membrane import Membrane
from lyra_petsc.terms.midedge import MidEdge
from lyra_petsc.terms.registry import Role
from lyra_petsc.terms.stretch import SOFTENS_BELOW
from lyra_petsc.terms.term import Elastic, UpcomingStep

EPSILON = 10.0 * float(np.finfo(np.float64).eps)
"""Relative round-off of a sum, as in `residual_roundoff`."""

MOST_PANELS, NEAR_PANELS = 16, (64, 1024)
"""Of the integral along the hinges' way, and fewest and most of that of contact, or one for half the gap.
With fewer, two values may agree by chance, as pairs with one feature become pairs with another."""

SAMPLES, WIDEST_TURN = 9, 1.0
"""Points of that way, and the turn [rad] between two of them beyond which a hinge may have jumped: one that
passes 180° changes its energy without a force, one whose triangle is turned over in its plane loses it and
has it back within a short way."""


Terms = Mapping[Elastic, Any]
"""Terms, and what each of them froze for the step."""


def gradient(terms: Terms, x: Array) -> Array:
    """Of the terms' energy at x (n_local, 3), [N]."""
    out = np.zeros_like(x)
    for term, frozen in terms.items():
        term.add_gradient(x, frozen, out)
    return out


def energy(terms: Terms, x: Array) -> float:
    """Of this rank's elements [J]."""
    return sum(float(term.energies(x, frozen).sum()) for term, frozen in terms.items())


def force_along(
    comm: MPI.Comm, n: int, terms: Terms, turned: Terms, x0: Array, dx: Array, *, enough: float
) -> tuple[float, bool]:
    """∫₀¹ ∇E(x0 + s Δx)·Δx ds [J], and whether some of it is from energies; collective.

    Exact for the membrane, whose energy is a quartic along a line; refined until it stands for the rest.

    Parameters
    ----------
    n : int
        Owned vertices of this rank.
    terms : mapping of Elastic to what it froze for the step
    turned : mapping of Elastic
        Of those whose frames turned within the step, the frames in which it began.
    x0, dx : (n_local, 3)
        Where the way begins, and the way [m].
    enough : float
        Error [J] that does not matter.
    """
    smooth: Terms = {term: frozen for term, frozen in terms.items() if isinstance(term, Membrane)}
    near = {term: frozen for term, frozen in terms.items() if term.registration.neighbours}
    bent = {term: frozen for term, frozen in terms.items() if term not in smooth and term not in near}

    def refined(which: Terms, panels: int, most: int) -> float | None:
        """The integral of these terms' forces, from so many panels on; None if it does not stand."""
        before, fine = math.nan, panels >= most
        while not fine:
            now = _integral(comm, which, n, x0, dx, panels, 5)
            if abs(now - before) <= max(enough, EPSILON * abs(now)):
                return now
            before, fine, panels = now, panels >= most, 2 * panels
        return None

    value, followed = _integral(comm, smooth, n, x0, dx, 1, 2), True
    widest = math.inf if turned else _widest_turn(bent, x0, dx)
    follows = comm.allreduce(widest, op=MPI.MAX) < WIDEST_TURN
    # a barrier is as wide as its gap; second derivatives leap where nearest points go from edge to triangle
    farthest, skin = largest(comm, dx[:n]), min((term.skin for term in near), default=0.0)
    fewest, most_near = NEAR_PANELS
    panels = max(fewest, math.ceil(farthest / skin)) if skin > 0.0 else fewest
    for which, known, first, most in ((bent, follows, 1, MOST_PANELS), (near, True, panels, most_near)):
        if which:
            found = refined(which, first, most) if known else None
            if found is None:
                then = {term: turned.get(term, frozen) for term, frozen in which.items()}
                change = energy(which, x0 + dx) - energy(then, x0)
                found, followed = float(comm.allreduce(change)), False
            value += found
    return value, not followed


def _integral(comm: MPI.Comm, terms: Terms, n: int, x0: Array, dx: Array, panels: int, points: int) -> float:
    """∫₀¹ ∇E(x0 + s Δx)·Δx ds [J] by Gauss's rule on equal panels; collective."""
    nodes, weights = np.polynomial.legendre.leggauss(points)  # type: ignore[no-untyped-call]
    value = 0.0
    for panel in range(panels if terms else 0):
        for node, weight in zip(nodes, weights, strict=True):
            s = (panel + 0.5 * (1.0 + node)) / panels
            value += 0.5 * weight * float(np.vdot(gradient(terms, x0 + s * dx)[:n], dx[:n]))
    return float(comm.allreduce(value / panels))


def _widest_turn(terms: Terms, x0: Array, dx: Array) -> float:
    """Largest change [rad] of a hinge's angle between two of `SAMPLES` points of the way."""
    widest = 0.0
    for term in terms:
        if isinstance(term, Bending):
            before = term.angles(x0)
            for s in np.linspace(0.0, 1.0, SAMPLES)[1:]:
                now = term.angles(x0 + s * dx)
                widest = max(widest, float(np.abs(now - before).max(initial=0.0)))
                before = now
    return widest


@dataclass(frozen=True, kw_only=True)
class StepBalance:
    """The balances of one step; J, N, kg m/s and kg m²/s, the same on every rank.

    Attributes
    ----------
    change : float
        Of kinetic + potential energy in the step.
    numerical, viscous : float
        ½ ‖Δv‖²_M and Δt v'ᵀ D v'.
    bracket, work : float
    defect, tolerance : float
        Left minus right side of the energy identity, and what it may be.
    residual, promised, floor : float
        Norm of the forces left on free coordinates, what the solver promised, and its round-off.
    driving : float
        Norm of the largest of the other forces there, those within the sheet left out.
    push : float
        How far those forces moved the sheet [m]: largest change of a free coordinate beyond Δt v.
    momentum, momentum_tolerance : float
        Largest component of Δ(Σ m v) − Δt Σ forces from outside.
    spin, spin_tolerance : float
        Of Σ (x' − centre) × (m Δv) − Δt Σ torques.
    jumped : bool
        Hinges turned too far to follow, or parts in contact went far over the gap; their part of the bracket
        is from their energies.
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
    push: float
    momentum: float
    momentum_tolerance: float
    spin: float = 0.0
    spin_tolerance: float = 0.0
    jumped: bool = False

    @property
    def moved(self) -> float:
        """Energy [J] that the step turned over."""
        return abs(self.change) + self.numerical + abs(self.viscous) + abs(self.bracket) + abs(self.work)


def largest(comm: MPI.Comm, values: Array) -> float:
    """Largest size of all values on all ranks."""
    return float(comm.allreduce(float(np.abs(values).max(initial=0.0)), op=MPI.MAX))


def _in_space(term: Elastic) -> bool:
    """Whether a term of the sheet's energy also pushes from outside: clamps and contact with obstacles."""
    return term.registration.moving or term.registration.neighbours


class Accountant:
    """Takes the balance of each step of a simulation by backward Euler; collective.

    Parameters
    ----------
    simulation : SteppedScene
        Before its first step; `look` must see every state from which a step starts.
    """

    def __init__(self, simulation: SteppedScene) -> None:
        self._simulation = simulation
        self._system = simulation.problem.system
        pulls = [term for term in self._system.active.elastic if term.registration.role is Role.CONSTRAINT]
        self._pulling, self._elastic = pulls, [t for t in self._system.active.elastic if t not in pulls]
        self.look()

    @property
    def _shell(self) -> Terms:
        """The sheet's own terms, with targets where they stand now."""
        return {term: self._system.active.frozen[term] for term in self._elastic}

    @property
    def _springs(self) -> Terms:
        """The terms by which handles pull."""
        return {term: self._system.active.frozen[term] for term in self._pulling}

    def look(self) -> None:
        """Note the state, and the energy with which its clamps end the step before."""
        system = self._system
        self._x, self._v = system.x.copy(), system.v.copy()
        self._energy = energy(self._shell, system.x)
        self._frames: Terms = {term: term.frames for term in self._elastic if isinstance(term, MidEdge)}

    @property
    def _solved(self) -> Array:
        """Velocities (n_local, 3) [m/s] that the step's equations led to, before dashpots of impacts."""
        return self._system.v if self._system.contact_impulses is None else self._system.evaluated[1]

    def _fit(self) -> None:
        """Give the positions in which the step began the ghosts that contact needs now; collective."""
        layout = self._system.points
        self._x = resized(self._x, layout.n_owned, layout.n_local)
        layout.update_ghosts(self._x)

    @property
    def _turned(self) -> Terms:
        """Terms whose frames have turned since the step began, in those of its beginning."""
        now = self._system.active.frozen
        return {term: frames for term, frames in self._frames.items() if now[term] is not frames}

    def balance(self, report: StepReport) -> StepBalance:
        """The balance of the step just accepted, which started from the state looked at last."""
        system, comm = self._system, self._system.points.comm
        n, dt = system.points.n_owned, report.dt
        self._fit()
        x0, v0, x1, v1 = self._x, self._v, system.x, self._solved
        dx, dv = x1 - x0, v1[:n] - v0[:n]
        free = ~system.prescribed.mask[:n]
        parts = self._parts(report, dv / dt)
        reaction = self._simulation.ledger.reaction
        if system.contact_impulses is not None:  # after the equations were solved
            at = system.prescribed.indices
            reaction.put(at, reaction.take(at) - system.contact_impulses.handle_force)
        weight = self._gravity(report)
        moved = dx[:n]
        outside = -parts["loads"] + reaction
        for name in ("springs", "wind"):
            outside = outside - parts[name]
        # planes of clamps and obstacles stand in space: their energy is stored, but they push from outside
        planes = {term: frozen for term, frozen in self._shell.items() if _in_space(term)}
        pushed = gradient(planes, x1)[:n]
        slowed = self._damping(planes, v1)[:n]
        energy_now, energy_then = energy(self._shell, x1), energy({**self._shell, **self._turned}, x0)
        turned = energy_then - self._energy
        mass, size_of_g = system.mass[:, None], float(np.linalg.norm(self._simulation.scene.gravity or 0.0))
        (kinetic0, kinetic1, elastic, turn, fallen0, fallen1, numerical, viscous, inner, outer,
         free_way, way, energy_noise, forces, powers, heights) = system.points.global_sum(
            0.5 * float(np.sum(mass * v0[:n] ** 2)),
            0.5 * float(np.sum(mass * v1[:n] ** 2)),
            energy_now - energy_then,
            turned,
            sum(load.potential(x0) for load in system.active.loads),
            sum(load.potential(x1) for load in system.active.loads),
            0.5 * float(np.sum(mass * dv**2)),
            float(np.vdot(parts["damping"], moved)),
            float(np.vdot(parts["internal"], moved)),
            float(np.vdot(outside - weight, moved)),
            float(np.sum(moved**2, where=free)),
            float(np.sum(moved**2)),
            self._energy_roundoff(x1) + self._energy_roundoff(x0),
            float(sum(np.abs(part).sum() for part in parts.values())),
            float(sum(np.abs(part * moved).sum() for part in parts.values())),
            float(np.abs(mass * np.abs(system.x[:n])).sum()) * size_of_g,
        ).tolist()  # fmt: skip
        reach = largest(comm, x1)
        left = self._left(parts, reach, dt)
        solved = left["residual"] * np.sqrt(free_way) + left["floor"] * np.sqrt(way)
        # positions are rounded, too: x' − x is Δt v' only to their last digit
        noise = EPSILON * (energy_noise + powers + forces * reach + kinetic0 + kinetic1 + heights)
        tolerance = float(solved + noise)
        along, jumped = force_along(comm, n, self._shell, self._turned, x0, dx, enough=0.1 * tolerance)
        bracket = along - inner
        change = kinetic1 - kinetic0 + elastic + turn + fallen1 - fallen0
        work = outer + turn
        defect = change - (-numerical - viscous + bracket + work)
        gap = mass * dv - dt * (outside - pushed - slowed)
        unsolved = left["residual"] + left["floor"]
        damped = gap + dt * (parts["damping"] - slowed)
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
            **self._momenta(gap, damped, dt, unsolved, forces, reach),
        )

    def _left(self, parts: Mapping[str, Array], reach: float, dt: float) -> dict[str, float]:
        """Norms [N] of what is left of the forces, of what the solver promised, its floor of round-off and
        the driving forces, and how far they moved the sheet [m]; by the names of `StepBalance`."""
        system, simulation = self._system, self._simulation
        free = ~system.prescribed.mask[: system.points.n_owned]
        everything = [*parts.values(), np.asarray(sum(parts.values()))]
        squares = system.points.global_sum(*(float(np.sum(part**2, where=free)) for part in everything))
        *each, residual = np.sqrt(squares).tolist()
        floor = residual_roundoff(system, max(reach, simulation.problem.outline.largest_coordinate))
        n = len(free)
        way = system.x[:n] - self._x[:n] - dt * self._v[:n]
        return {
            "residual": residual,
            "promised": max(simulation.scene.solver.force_tolerance * max(each), floor),
            "floor": floor,
            "driving": max(norm for name, norm in zip(parts, each, strict=True) if name != "internal"),
            "push": largest(system.points.comm, np.where(free, way, 0.0)),
        }

    # -- parts ---------------------------------------------------------------------------------------

    def _parts(self, report: StepReport, rate: Array) -> dict[str, Array]:
        """The summands of F, each (n_owned, 3) [N], evaluated anew; loads with their sign in F."""
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
            "internal": gradient(self._shell, x1)[:n],
            "springs": gradient(self._springs, x1)[:n],
            "damping": self._damping(self._shell, v1)[:n],
            "wind": wind[:n],
            "loads": -force[:n],
        }

    def _damping(self, terms: Terms, v: Array) -> Array:
        """D v (n_owned, 3) [N], assembled anew with the stiffness of the start of the step."""
        system = self._system
        rows = system.discretisation.fixed
        values = rows.zeros()
        for term, frozen in terms.items():
            gamma = term.elements.data.get("damping")
            if term.registration.damped and gamma is not None and np.any(gamma):
                at_start = system.damping.frozen.get(term, frozen)
                rows.add_stiffness(term, self._x, at_start, 1.0, gamma, values)
        return rows.product(values, v)

    def _gravity(self, report: StepReport) -> Array:
        """The weight (n_owned, 3) [N], whose work is in the potential."""
        out = np.zeros((self._system.points.n_local, 3))
        for load in self._system.active.loads:
            if load.registration.energy:
                load.add_force(self._x, report.time - report.dt, report.time, out)
        return out[: self._system.points.n_owned]

    def _energy_roundoff(self, x: Array) -> float:
        """Sum [J] over this rank's elements whose relative round-off their energies carry.

        An energy ½ k s² whose strain s is a difference of coordinates is uncertain by √(2 E S) ε, with S
        the energy at which the strain is of order one.
        """
        reach = float(np.abs(x).max(initial=0.0))
        amount = 0.0
        for term, frozen in self._shell.items():
            each = term.energies(x, frozen)
            scale = reach * term.force_scale(reach)[: term.n_owned]
            amount += float(np.sum(np.abs(each) + np.sqrt(2.0 * np.abs(each) * scale)))
            amount += EPSILON * float(np.sum(scale))
        return amount

    def _momenta(
        self, gap: Array, damped: Array, dt: float, left: float, forces: float, reach: float
    ) -> dict[str, float]:
        """Defects of linear and angular momentum and their tolerances.

        ``gap`` (n_owned, 3) is m Δv less Δt times the forces from outside, ``damped`` also less those of
        damping: frozen with the start's geometry they add up to nothing, but turn the sheet.
        """
        system, comm = self._system, self._system.points.comm
        n, count = system.points.n_owned, system.points.n_global
        x, mass = system.x[:n], system.mass[:, None]
        centre = comm.allreduce(np.append((mass * x).sum(axis=0), mass.sum()))
        arms = x - centre[:3] / centre[3]
        arms = arms[: system.points.n_vertices]
        turned = np.cross(arms, damped[: len(arms)]).sum(axis=0)
        for term, frozen in self._shell.items():
            if isinstance(term, MidEdge):
                own = np.flatnonzero(term.edge_indices < 3 * n)
                turned += term.moment(damped.ravel()[term.edge_indices[own]], own, system.x, frozen)
        sums = comm.allreduce(np.concatenate([gap[: len(arms)].sum(axis=0), turned]))
        longest = float(comm.allreduce(float(np.square(arms).sum())))
        noise = EPSILON * forces * dt
        linear = dt * left * np.sqrt(count) + noise
        angular = dt * left * np.sqrt(longest) + noise * reach
        return {
            "momentum": float(np.abs(sums[:3]).max()),
            "momentum_tolerance": float(linear),
            "spin": float(np.abs(sums[3:]).max()),
            "spin_tolerance": float(angular),
        }


class StageAccountant(Accountant):
    """Takes what balances of each step there are; collective. See `Accountant`."""

    def balance(self, report: StepReport) -> StepBalance:
        """The balance of the step just accepted: ``change`` is that of the elastic energy, ``bracket`` the
        integral of the elastic forces, and nothing is known of ``numerical``, ``viscous`` and ``work``."""
        system, comm = self._system, self._system.points.comm
        n, dt = system.points.n_owned, report.dt
        self._fit()
        x0, x1 = self._x, system.x
        # targets that move stand where the step ends by now; damping is right in the frames of the step
        system.active.move_targets(self._at(system.t0 + system.stage.offset))
        parts = dict(system.forces_at_stage())
        ended = self._at(system.t1)
        frozen = {term: term.freeze(ended) for term in system.active.elastic}
        system.active.frozen = system.active.frozen | frozen
        total = np.asarray(sum(parts.values()))
        gap = total - self._simulation.ledger.reaction
        if not any(_in_space(term) for term in self._shell):
            # they push from outside, and cannot be told from the sheet's own forces here
            gap = gap - parts["internal"] - parts.get("damping", 0.0)
        change, noise, forces, way, *gaps = system.points.global_sum(
            energy(self._shell, x1) - energy({**self._shell, **self._turned}, x0),
            self._energy_roundoff(x1) + self._energy_roundoff(x0),
            float(sum(np.abs(part).sum() for part in parts.values())),
            float(np.sum((x1 - x0)[:n] ** 2)),
            *gap[: system.points.n_vertices].sum(axis=0),
        ).tolist()
        reach = largest(comm, x1)
        left = self._left(parts, reach, dt)
        unsolved = (left["residual"] + left["floor"]) * math.sqrt(system.points.n_global)
        tolerance = EPSILON * (noise + forces * reach) + left["floor"] * math.sqrt(way)
        moved = x1 - x0
        along, jumped = force_along(comm, n, self._shell, self._turned, x0, moved, enough=0.1 * tolerance)
        return StepBalance(
            change=change,
            bracket=along,
            defect=change - along,
            tolerance=tolerance,
            momentum=dt * max(map(abs, gaps)),
            momentum_tolerance=dt * (unsolved + EPSILON * forces),
            jumped=jumped,
            **left,
        )

    def _at(self, time: float) -> UpcomingStep:
        """The step, as terms see it at a time [s] of it."""
        system = self._system
        return UpcomingStep(system.t0, system.t1, time, system.x, system.reference.at)


@dataclass
class Record:
    """A case's steps, the same on every rank.

    Attributes
    ----------
    planned : int
        Steps at the nominal Δt.
    nominal : float
        That Δt [s].
    end : float
        Time [s] to reach.
    start_energy : float
        Kinetic + potential at the start [J].
    reports : list of StepReport
        One for each accepted step.
    balances : list of StepBalance
        One for each; empty for the semi-implicit method, which solves no step.
    energies : list of float
        Kinetic + potential after each [J].
    observed : list
        What the case observes, from the start on.
    notes : list of str
        Of the simulation.
    stopped : str
        Why it did not reach its end; empty if it did.
    integrator : str
    balance : dict
        The whole run's energy balance, as in summary.json; empty where nothing ran.
    busy : list of float
        CPU time of each step [s], of the rank that took most.
    last : (V, 3) array or None
        Positions [m] after the last step, on rank 0; None if none were gathered, or they are freed.
    triangles : (F, 3) array or None
        On rank 0.
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
    stopped: str = ""
    integrator: str = "beuler"
    balance: dict[str, Any] = field(default_factory=dict)
    busy: list[float] = field(default_factory=list)
    last: StoredArray | None = None
    triangles: StoredArray | None = None

    @property
    def newton(self) -> list[int]:
        """Newton iterations of each step, those of its rejected attempts included."""
        return [report.newton_iterations for report in self.reports]

    @property
    def linear(self) -> int:
        """Linear iterations of all steps."""
        return sum(report.linear_iterations for report in self.reports)

    @property
    def rejected(self) -> int:
        """Attempts that failed, or were too inaccurate."""
        return sum(report.rejected for report in self.reports)

    @property
    def smallest_step(self) -> float:
        """Smallest Δt [s] of an accepted step; NaN without any."""
        return min((report.dt for report in self.reports), default=math.nan)

    @property
    def stretches(self) -> tuple[float, float]:
        """Smallest and largest principal stretch met; NaN without a step."""
        if not self.reports:
            return math.nan, math.nan
        return (
            min(report.smallest_stretch for report in self.reports),
            max(report.largest_stretch for report in self.reports),
        )

    @property
    def median_seconds(self) -> float:
        """Median wall time of a step; NaN without any."""
        return statistics.median(r.wall_seconds for r in self.reports) if self.reports else math.nan

    @property
    def median_busy(self) -> float:
        """Median CPU time of a step; NaN without any."""
        return statistics.median(self.busy) if self.busy else math.nan

    @property
    def median_newton(self) -> float:
        """Median Newton iterations of a step; NaN without any."""
        return float(statistics.median(self.newton)) if self.reports else math.nan

    @property
    def lost(self) -> float:
        """Numerical dissipation over the largest energy at work; NaN without a step."""
        return float(self.balance.get("numerical_dissipation", math.nan)) if self.reports else math.nan

    @property
    def times(self) -> list[float]:
        """Times [s] at which steps ended."""
        return [report.time for report in self.reports]


RESOLVED = 0.1
"""Part of the forces that move a sheet, or of how far they do, below which the rest is negligible."""

LITTLE_LOST = 0.05
"""Numerical dissipation over the largest energy at work up to which a motion may be called right."""

MUCH_LOST = 0.5
"""Beyond which one is wrong whose steps nothing else speaks for."""

MOST_NEWTON_MEDIAN, MOST_NEWTON = 10, 30
"""Newton iterations a step of a stiff sheet may take, in the median and at worst."""

MOST_TIME = 5.0
"""Wall time of a step of a stiff sheet over that of the base scene, medians."""


def converged(record: Record) -> Verdict:
    """Every step was solved, and the end reached."""
    if record.stopped:
        return Verdict(False, f"{len(record.reports)} steps, then: {record.stopped}")
    words = f"all {len(record.reports)} steps"
    if record.rejected:
        smallest = short(record.smallest_step)
        words += (
            f", {record.rejected} attempts rejected, smallest Δt {smallest} s of {short(record.nominal)} s"
        )
    return Verdict(bool(record.reports), words)


def solved(record: Record) -> Verdict:
    """The forces left, computed anew, are as small as the solver promised in every step."""
    number, worst = _worst(record, lambda b: over(b.residual, b.promised + b.floor))
    at_floor = sum(balance.promised <= balance.floor for balance in record.balances)
    words = (
        f"worst in step {number}: {short(worst.residual)} N left on the free vertices, "
        f"{short(worst.promised)} N promised"
    )
    if at_floor:
        words += f"; in {at_floor} steps that is the floor of round-off"
    return Verdict(worst.residual <= worst.promised + worst.floor, words)


def resolved(record: Record) -> Verdict:
    """The forces left are far below those that move the sheet, or what they still move is.

    At the floor of round-off stiff forces may be left that are as large as the weight, and move nothing.
    """
    steps = zip(record.balances, record.reports, strict=True)
    by_force = [over(balance.residual, RESOLVED * balance.driving) for balance in record.balances]
    by_way = [over(report.remaining, RESOLVED * balance.push) for balance, report in steps]
    number = max(range(len(by_force)), key=lambda i: min(by_force[i], by_way[i]))
    worst, last = record.balances[number], record.reports[number].remaining
    words = (
        f"worst in step {number + 1}: {short(worst.residual)} N left, {short(worst.driving)} N move the sheet"
    )
    if worst.promised <= worst.floor:
        words += "; round-off at this stiffness allows no better"
    if by_way[number] < by_force[number]:
        words += f"; they still move it by {short(last)} m, and the step's forces by {short(worst.push)} m"
    return Verdict(min(by_force[number], by_way[number]) <= 1.0, words)


def identity(record: Record) -> Verdict:
    """The energy identity of backward Euler holds in every step to what its residual allows.

    Of other integrators: the elastic forces along each step add up to the change of their energy.
    """
    number, worst = _worst(record, lambda b: over(abs(b.defect), b.tolerance))
    words = (
        f"worst in step {number}: off by {short(abs(worst.defect))} J, tolerance {short(worst.tolerance)} J, "
        f"{short(worst.moved)} J turned over"
    )
    jumped = sum(balance.jumped for balance in record.balances)
    if jumped:
        words += (
            f"; in {jumped} steps hinges turned too far or jumped, or contact came from too far, and count "
            "by their energies"
        )
    return Verdict(abs(worst.defect) <= worst.tolerance, words)


def no_gain(record: Record) -> Verdict:
    """Where the bracket of the identity is not positive, no more energy than the work put in."""
    steps = [
        (number, balance)
        for number, balance in enumerate(record.balances, 1)
        if not balance.bracket > balance.tolerance
    ]
    fed = len(record.balances) - len(steps)
    more = f"; in {fed} steps buckling could feed energy in" if fed else ""
    if not steps:
        return Verdict(True, f"not to be judged{more}")
    number, worst = max(steps, key=lambda step: over(_gain(step[1]), step[1].tolerance))
    gain = _gain(worst)
    if gain > worst.tolerance:
        words = f"step {number} gained {short(gain)} J beyond the work, tolerance {short(worst.tolerance)} J"
        return Verdict(False, words + more)
    negative = [n for n, b in enumerate(record.balances, 1) if -b.viscous > b.tolerance]
    if negative:
        return Verdict(False, f"damping fed energy into step {negative[0]}{more}")
    return Verdict(True, f"none in the {len(steps)} steps where the elastic energy is convex{more}")


def whole(record: Record) -> Verdict:
    """The run as a whole makes no energy, and where its steps are not solved, does not lose most of it."""
    gained, lost = (float(record.balance[f"numerical_{what}"]) for what in ("gain", "dissipation"))
    net = gained - lost
    words = (
        f"{100.0 * lost:.2g} % of the largest energy at work lost to the integrator, "
        f"{100.0 * gained:.2g} % made by it"
    )
    if record.balance["repeated"]:
        words += f", {record.balance['repeated']} attempts repeated for it"
    good = net <= LARGEST_SUM and (record.integrator != "semi-implicit" or lost <= MUCH_LOST)
    if good and lost > LITTLE_LOST:
        words += "; solved, but a smaller Δt moves otherwise"
    return Verdict(good, words)


def momentum(record: Record) -> Verdict:
    """Momentum and angular momentum change by what acts from outside: inner forces add up to nothing."""
    at, line = _worst(record, lambda b: over(b.momentum, b.momentum_tolerance))
    turn_at, turn = _worst(record, lambda b: over(b.spin, b.spin_tolerance))
    words = f"worst in step {at}: {short(line.momentum)} N s, tolerance {short(line.momentum_tolerance)} N s"
    if turn.spin_tolerance:
        words += (
            f"; angular in step {turn_at}: {short(turn.spin)} N m s, "
            f"tolerance {short(turn.spin_tolerance)} N m s"
        )
    good = line.momentum <= line.momentum_tolerance and turn.spin <= turn.spin_tolerance
    return Verdict(good, words)


def softening(record: Record) -> Verdict:
    """A triangle compressed beyond where the model softens was reported."""
    smallest = record.stretches[0]
    if not smallest < SOFTENS_BELOW:
        return Verdict(True, f"no triangle below {SOFTENS_BELOW:.3f} of its length")
    told = [note for note in record.notes if "St. Venant-Kirchhoff model softens" in note]
    words = f"down to {short(smallest)} of its length, " + (
        "which is said" if told else "and NOTHING was said"
    )
    return Verdict(bool(told), words)


def speed(record: Record, ratio: float, busy_ratio: float) -> Verdict:
    """Few iterations, and a time like that of the base scene.

    ``ratio`` of the medians of wall time, ``busy_ratio`` of CPU time: on a machine that others use, too,
    the former says little of what a step costs, and one that is good enough suffices.
    """
    median, worst = record.median_newton, max(record.newton, default=0)
    good = median <= MOST_NEWTON_MEDIAN and worst <= MOST_NEWTON and min(ratio, busy_ratio) <= MOST_TIME
    words = (
        f"Newton iterations {short(median)} in the median and {worst} at worst "
        f"({MOST_NEWTON_MEDIAN} and {MOST_NEWTON} allowed), {short(ratio)} times the base's wall time, "
        f"{short(busy_ratio)} times its CPU time ({MOST_TIME:g} allowed)"
    )
    return Verdict(good and not record.stopped, words)


def of_physics(record: Record) -> dict[str, Verdict]:
    """All verdicts that need no knowledge of the case, by name."""
    verdicts = {"converged": converged(record)}
    if record.balances:
        verdicts |= {
            "equations": solved(record),
            "resolved": resolved(record),
            "energy": identity(record),
            "momentum": momentum(record),
        }
        if record.integrator == "beuler":
            verdicts["no gain"] = no_gain(record)
    if record.reports:
        verdicts["softening"] = softening(record)
        if record.balance:
            verdicts["whole run"] = whole(record)
    return verdicts


def _gain(balance: StepBalance) -> float:
    return balance.change - balance.work


def over(amount: float, tolerance: float) -> float:
    """How many times the tolerance; what is no number is worst."""
    if math.isnan(amount) or math.isnan(tolerance):
        return math.inf
    return amount / tolerance if tolerance > 0.0 else math.copysign(math.inf, amount) if amount else 0.0


def _worst(record: Record, measure: Callable[[StepBalance], float]) -> tuple[int, StepBalance]:
    """Number, from 1, and balance of the step for which ``measure`` is largest."""
    number = max(range(len(record.balances)), key=lambda i: measure(record.balances[i]))
    return number + 1, record.balances[number]
