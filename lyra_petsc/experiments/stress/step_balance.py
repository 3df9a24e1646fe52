"""Balances of energy and momentum of a time step: forces, computed again, against the ledger of the run.

Backward Euler satisfies an energy identity; with the masses M, the elastic energy E and x' − x = Δt v' = Δx::

    Δ(kinetic + potential) = −½ ‖Δv‖²_M − Δt v'ᵀ D v' + bracket + work
    bracket = ∫₀¹ ∇E(x + s Δx)·Δx ds − ∇E(x')·Δx

The ledger (`StepAccount`) has the bracket that energies, works and heat leave; the right side consists of
forces, so that forces which are not the gradient of their energy violate it, as does a step that was not
solved. The integral is exact for the membrane (its energy is a quartic along a line). For hinges and contact
its panels are halved where it has not converged; where hinges jump, as their model does beyond 180°, it is
replaced by the difference of their energies.

Every step leaves a residual r on the free coordinates. The solver promises ‖r‖ ≤ force tolerance × largest
force, or the round-off floor; this is judged separately. Given r, the energy identity may be violated by
‖r‖ ‖Δx‖ plus the round-off of its terms, and the balance of momentum by √V ‖r‖ Δt. These are the tolerances;
none of them is chosen.

The stage of any other integrator solves M v̇ + ∇E + D v = f. There is no energy identity, but the work of the
elastic forces along a step must equal the change of the elastic energy.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array
from lyra_petsc.scene import time_curve
from lyra_petsc.stepping.energy_balance import StepAccount
from lyra_petsc.stepping.newton.force_scales import ROUNDOFF, residual_roundoff
from lyra_petsc.stepping.simulation import SteppedScene, StepReport
from lyra_petsc.terms.bending.hinge import Bending
from lyra_petsc.terms.bending.midedge import MidEdge
from lyra_petsc.terms.membrane import Membrane
from lyra_petsc.terms.protocols import MovingTargets
from lyra_petsc.terms.term import Elastic

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
    comm: MPI.Comm,
    n: int,
    terms: Terms,
    start_frames: Terms,
    x0: Array,
    dx: Array,
    tolerance: float,
    skin: float = math.inf,
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
    skin : float
        That of contact [m].
    """
    from scipy.integrate import fixed_quad, quad_vec

    membrane: Terms = {term: frozen for term, frozen in terms.items() if isinstance(term, Membrane)}
    contact = {term: frozen for term, frozen in terms.items() if term.registration.of_contact}
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
            epsrel=ROUNDOFF,
            limit=panels + HALVED_PANELS,
            full_output=True,
        )
        return float(value) if info.success else None

    along_membrane, _ = fixed_quad(lambda at: np.array([power(membrane, s) for s in at]), 0.0, 1.0, n=2)
    value, by_energies = float(along_membrane), False
    turn = math.inf if start_frames else _largest_turn(hinges, x0, dx)
    smooth = comm.allreduce(turn, op=MPI.MAX) < LARGEST_TURN
    panels = max(CONTACT_PANELS, math.ceil(largest(comm, dx[:n]) / skin))
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
    account : StepAccount
        Energies, works and heat of the step, as the run's ledger has them.
    defect, tolerance : float
        Difference of the energies of the ledger and the work of the forces, and its tolerance.
    turned_over : float
        Sum of the sizes of what is compared.
    residual, promised, floor : float
        Norm of the residual on free coordinates, the norm that the solver promised, and the round-off floor.
    driving : float
        Norm on free coordinates of the largest kind of force, internal forces excluded.
    displacement : float
        Displacement by these forces [m]: largest change of a free coordinate beyond Δt v.
    momentum, momentum_tolerance : float
        Largest component of Δt (Σ inertial forces − Σ external forces), and its tolerance.
    angular, angular_tolerance : float
        Largest component of Σ (x' − centre) × (m Δv) − Δt Σ torques, and its tolerance; 0 if not computed.
    jumped : bool
        Hinges turned too far, or contacts moved much farther than the gap, for their forces to be integrated;
        their part of the work is computed from energies.
    """

    account: StepAccount
    defect: float
    tolerance: float
    turned_over: float
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


def largest(comm: MPI.Comm, values: Array) -> float:
    """Largest absolute value on all ranks."""
    return float(comm.allreduce(float(np.abs(values).max(initial=0.0)), op=MPI.MAX))


class BalanceRecorder:
    """Computes the balance of each step; collective.

    Parameters
    ----------
    simulation : SteppedScene
        Before its first step; `record_state` must be called before every step.
    """

    def __init__(self, simulation: SteppedScene) -> None:
        self._simulation = simulation
        self._equations = equations = simulation.problem.equations
        self._identity = equations.integrators.usual.name == "beuler"
        constraints = equations.active.external
        self._sheet_terms = [term for term in equations.active.elastic if term not in constraints]
        # with their targets in motion, energies of other terms change with positions alone
        self._turning = equations.active.moving
        self.record_state()

    def record_state(self) -> None:
        """Store the state, and the energy of terms with the targets at the end of the last step."""
        equations = self._equations
        self._x, self._v = equations.x.copy(), equations.v.copy()
        self._turning_energy = energy(self._frozen(self._turning), equations.x)
        self._frames: Terms = {term: term.frames for term in self._sheet_terms if isinstance(term, MidEdge)}

    def _frozen(self, terms: Iterable[Elastic]) -> Terms:
        """Terms with their present frozen data."""
        return {term: self._equations.step.frozen[term] for term in terms}

    def balance(self, report: StepReport) -> StepBalance:
        """The balance of the step just accepted, which started from the state recorded last."""
        equations, simulation = self._equations, self._simulation
        layout, account = equations.points, simulation.energy_balance.account
        comm, n, dt = layout.comm, layout.n_owned, report.dt
        self._x, self._v = (layout.extended(values[:n]) for values in (self._x, self._v))
        x0, x1 = self._x, equations.x
        dx, sheet = x1 - x0, self._frozen(self._sheet_terms)
        frames = {term: old for term, old in self._frames.items() if sheet[term].number != old.number}
        parts, within = self._force_terms(dt)
        size_of_g = float(np.linalg.norm(time_curve.largest(simulation.scene.gravity)))
        turned, inner, free_dx, all_dx, energy_noise, forces, powers, heights = layout.global_sum(
            energy(self._frozen(self._turning), x0) - self._turning_energy,
            float(np.vdot(parts["internal"], dx[:n])),
            float(np.sum(dx[:n] ** 2, where=equations.step.prescribed.free)),
            float(np.sum(dx[:n] ** 2)),
            self._energy_roundoff(x1) + self._energy_roundoff(x0),
            float(sum(np.abs(part).sum() for part in parts.values())),
            float(sum(np.abs(part * dx[:n]).sum() for part in parts.values())),
            float(np.abs(equations.mass[:, None] * np.abs(x1[:n])).sum()) * size_of_g,
        ).tolist()
        reach = largest(comm, x1)
        left = self._residual_norms(parts, reach, dt)
        noise, floor = energy_noise + forces * reach, left["floor"] * math.sqrt(all_dx)
        if self._identity:  # x' − x equals Δt v' only to the last digit of x
            noise += powers + account.before.kinetic + account.after.kinetic + heights
            floor += left["residual"] * math.sqrt(free_dx)
        tolerance = floor + ROUNDOFF * noise
        skin = math.inf if equations.contact is None else equations.contact.skin
        work, jumped = force_work(comm, n, sheet, frames, x0, dx, 0.1 * tolerance, skin)
        change = account.after.elastic - account.before.elastic + account.fabric_heat
        sizes = [change, work]
        if self._identity:
            change, work = account.bracket + account.moved, work - inner
            sizes = [account.change, account.inertia, account.heat, account.bracket, account.external]
        return StepBalance(
            account=account,
            defect=change - turned - work,
            tolerance=tolerance,
            turned_over=sum(map(abs, sizes)),
            jumped=jumped,
            **left,
            **self._momentum_defects(parts, within, dt, left["residual"] + left["floor"], forces, reach),
        )

    def _residual_norms(self, parts: Mapping[str, Array], reach: float, dt: float) -> dict[str, float]:
        """Norms [N] of the residual, its promised bound, its round-off floor and the driving forces, and the
        displacement [m] by these; keys are fields of `StepBalance`."""
        equations, simulation = self._equations, self._simulation
        free = equations.step.prescribed.free
        everything = [*parts.values(), np.asarray(sum(parts.values()))]
        squares = equations.points.global_sum(*(float(np.sum(part**2, where=free)) for part in everything))
        *norms, residual = np.sqrt(squares).tolist()
        floor = residual_roundoff(equations.forces, max(reach, simulation.problem.whole.largest_coordinate))
        n = len(free)
        displacement = equations.x[:n] - self._x[:n] - dt * self._v[:n]
        return {
            "residual": residual,
            "promised": max(simulation.scene.solver.force_tolerance * max(norms), floor),
            "floor": floor,
            "driving": max(norm for name, norm in zip(parts, norms, strict=True) if name != "internal"),
            "displacement": largest(equations.points.comm, np.where(free, displacement, 0.0)),
        }

    def _force_terms(self, dt: float) -> tuple[dict[str, Array], tuple[Array, Array]]:
        """The terms of the residual at the stage of the step, each (n_owned, 3) [N], evaluated again; and the
        internal forces and those of damping without the terms that act from outside.
        """
        equations, n, stage = self._equations, self._equations.points.n_owned, self._equations.step.stage
        # before impacts, which act after the equations are solved
        x, v, y = equations.evaluated.x, equations.evaluated.v, self._x
        if self._simulation.last_integrator.centred:
            vertices = equations.points.are_vertices(equations.points.global_number)
            y = y + np.where(vertices[:, None], stage.offset * self._v, 0.0)
        step = equations.targets_at(equations.step.at_stage, y)
        frozen = dict(self._frozen(equations.active.elastic))
        if stage.offset < dt:  # moving targets are at the end of the step by now
            moved = (
                *equations.active.moving,
                *(t for t in equations.active.external if not t.registration.of_contact),
            )
            frozen |= {term: term.freeze(step) for term in moved}
        force, wind = np.zeros_like(x), np.zeros_like(x)
        for load in equations.active.loads:
            load.add_force(step, force)
        for term in equations.active.viscous:
            term.add_gradient(v, term.freeze(step), wind)
        rate = stage.sigma * (v[:n] - equations.step.v_h)
        if stage.offset < dt:  # handles do not have the integrator's accelerations
            at = equations.step.prescribed.indices
            equations.step.prescribed.overwrite(rate, (equations.v[:n] - equations.step.v_h).take(at) / dt)
        sheet: Terms = {term: frozen[term] for term in self._sheet_terms}
        # clamps and obstacles store energy, but exert external forces as they are fixed in space
        inner = {
            t: data
            for t, data in sheet.items()
            if not (isinstance(t, MovingTargets) or t.registration.of_contact)
        }
        parts = {
            "inertia": equations.mass[:, None] * rate,
            "internal": gradient(sheet, x)[:n],
            "springs": gradient({term: frozen[term] for term in equations.active.external}, x)[:n],
            "damping": self._damping(sheet, y, v),
            "wind": wind[:n],
            "loads": -force[:n],
        }
        if len(inner) == len(sheet):
            return parts, (parts["internal"], parts["damping"])
        return parts, (gradient(inner, x)[:n], self._damping(inner, y, v))

    def _damping(self, terms: Terms, y: Array, v: Array) -> Array:
        """D v (n_owned, 3) [N], assembled again with the stiffness at y (n_local, 3)."""
        rows = self._equations.discretisation.fixed
        values = rows.zeros()
        for term, frozen in terms.items():
            gamma = term.elements.data.get("damping")
            if term.registration.damped and gamma is not None and np.any(gamma):
                at_start = self._equations.damping.frozen.get(term, frozen)
                rows.add_stiffness(term, y, at_start, 1.0, gamma, values)
        return rows.product(values, v)[: self._equations.points.n_owned]

    def _energy_roundoff(self, x: Array) -> float:
        """Sum [J] over this rank's elements; times the machine epsilon it is the round-off of the energies.

        An energy E = ½ k s² whose strain s is a difference of coordinates has the error √(2 E S) ε, where S
        is the energy at a strain of order one.
        """
        reach, amount = float(np.abs(x).max(initial=0.0)), 0.0
        for term, frozen in self._frozen(self._sheet_terms).items():
            energies = np.abs(term.energies(x, frozen))
            scale = reach * term.force_scale(reach)[: term.n_owned]
            amount += float(np.sum(energies + np.sqrt(2.0 * energies * scale))) + ROUNDOFF * float(
                np.sum(scale)
            )
        return amount

    def _momentum_defects(
        self,
        parts: Mapping[str, Array],
        within: tuple[Array, Array],
        dt: float,
        left: float,
        forces: float,
        reach: float,
    ) -> dict[str, float]:
        """Defects of linear momentum, and for backward Euler of angular momentum, and their tolerances.

        The sum of damping forces, frozen with the geometry at the start, vanishes, but not their moment.
        """
        equations, comm = self._equations, self._equations.points.comm
        n, rows = equations.points.n_owned, slice(0, equations.points.n_vertices)
        reaction = self._simulation.energy_balance.reaction
        at = equations.step.prescribed.indices
        reaction.put(at, reaction.take(at) - equations.contact_end.impulses.handle_force)
        internal, damping = within
        damped = dt * (sum(parts.values()) - internal - reaction)
        linear = (damped - dt * damping)[rows].sum(axis=0)
        noise = ROUNDOFF * forces * dt
        defects = {
            "momentum": float(np.abs(comm.allreduce(linear)).max()),
            "momentum_tolerance": dt * left * math.sqrt(equations.points.n_global) + noise,
        }
        if not self._identity:
            return defects
        x, mass = equations.x[:n], equations.mass[:, None]
        centre = comm.allreduce(np.append((mass * x).sum(axis=0), mass.sum()))
        arms = x[rows] - centre[:3] / centre[3]
        moment = np.cross(arms, damped[rows]).sum(axis=0)
        for term, frozen in self._frozen(self._sheet_terms).items():
            if isinstance(term, MidEdge):
                own = np.flatnonzero(term.edge_indices < 3 * n)
                moment += term.moment(damped.ravel()[term.edge_indices[own]], own, equations.x, frozen)
        longest = math.sqrt(comm.allreduce(float(np.square(arms).sum())))
        return defects | {
            "angular": float(np.abs(comm.allreduce(moment)).max()),
            "angular_tolerance": dt * left * longest + noise * reach,
        }
