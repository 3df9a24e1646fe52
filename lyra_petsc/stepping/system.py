"""The reduced implicit system of one step: residual, Jacobian and objective in the velocities.

Unknown v (the velocity of the scheme's stage), with the scheme's history x_h, v_h and numbers σ, c::

    F(v, v̇) = M v̇ + ∇E(x_h + c v) + D v + ∇P(v) − f,  v̇ = σ (v − v_h)       Jacobian  σ M + c K + D + ∇∇P

with the elastic energy E, damping D = γ K⁺, the wind's potential P and the loads f. It is the gradient
of ``objective``. Backward Euler has x_h = x_n, v_h = v_n, σ = 1/c = 1/Δt: the Lyra paper, eq. 10-18, as
a Newton iteration. The geometry of D, P and f is frozen during a step: at x_n for first-order schemes,
at the extrapolated stage x_n + (t_s − t_n) v_n for second-order ones.

Arrays only: no PETSc here. Collective where sums over ranks are returned.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, partial, reduce

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.assembly.blocks import BlockRows
from lyra_petsc.handles.held import Held
from lyra_petsc.partition.points import Points
from lyra_petsc.remembered import Remembered
from lyra_petsc.stepping.clamped import clamped_energy
from lyra_petsc.stepping.damping import Damping
from lyra_petsc.stepping.departures import Departures
from lyra_petsc.stepping.prescribed import Prescribed
from lyra_petsc.stepping.schemes.scheme import Follower, Scheme, Stage
from lyra_petsc.terms.term import Elastic, Load, Viscous

Array = NDArray[np.float64]


class ReducedSystem:
    """One rank's part of the system, and the state (x_n, v_n) it starts a step from.

    Parameters
    ----------
    points : Points
    mass : (n_owned,) [kg]
    elastic, viscous, loads : lists of terms
    held : Held
    blocks : BlockRows
    scheme : Scheme
    starts : list of float
        Times [s] at which handles start to act.
    events : list of float
        Times [s] at which forces may jump.

    Attributes
    ----------
    x, v : (n_local, 3)
        Positions [m] and velocities [m/s] at the start of the step, ghosts up to date.
    history : (n_owned, 3)
        The stage's v_h [m/s].
    departures : Departures
    prescribed : Prescribed
        Coordinates that exact handles hold in the step.
    anchored : float
        Energy [J] of this rank's clamps at the start of the step, against where they stand at its stage.
    dt, t0, t1 : float
        Length, start and end of the step [s].
    followers : list of Follower
        Who must hear of jumps and of the accelerations after them: the scheme, an error estimate.
    load_factor : float
        Factor on all loads (1 in a motion).
    unbalanced, given_loads : (n_owned, 3) or None
        Static: force [N] of the start shape, let go of with the load factor; loads in place of the present.
    """

    def __init__(
        self,
        points: Points,
        mass: Array,
        elastic: list[Elastic],
        viscous: list[Viscous],
        loads: list[Load],
        held: Held,
        blocks: BlockRows,
        *,
        scheme: Scheme,
        starts: list[float],
        events: list[float],
    ) -> None:
        self.points, self.mass, self.scheme = points, mass, scheme
        self.elastic, self.viscous, self.loads, self.held = elastic, viscous, loads, held
        self._blocks, self._events = blocks, events
        self.departures = Departures(points, held, elastic, starts)
        self.prescribed = Prescribed(points, held, blocks)
        self._springs = [term for term in elastic if term.name == "spring"]
        self._shell = [term for term in elastic if term.name != "spring"]
        still = all(type(term).prepare is Elastic.prepare for term in self._shell)
        shell = partial(self._sum, self._shell)  # moving targets change the forces at one and the same place
        self._internal = Remembered(shell) if still else shell
        self._damping = Damping(points, blocks, elastic, moves=scheme.moves, once=scheme.explicit)
        last = (self._internal, self._damping.product) if scheme.explicit else ()
        self._asked_once = [each for each in last if isinstance(each, Remembered)]
        self.x, self.v, self._xs, self._vs, self._gradient = (np.zeros((points.n_local, 3)) for _ in range(5))
        self._xh, self.history = self.x, self.v[: points.n_owned]
        self.stage = Stage(1.0, 1.0, 1.0)
        self._force = np.zeros((points.n_local, 3))
        self._objectives: list[tuple[Array, tuple[float, float]]] = []
        self.dt = self.t0 = self.t1 = self.anchored = self._size = 0.0
        self.followers: list[Follower] = [scheme]
        self.load_factor = 1.0
        self.unbalanced: Array | None = None
        self.given_loads: Array | None = None
        self._iterate: Array | None = None
        self._last_parts: dict[str, Array] = {}

    def begin(self, time: float) -> None:
        """Let everything that starts to act by ``time`` [s] set out from the present positions."""
        self.departures.until(time, self.x)

    # -- a step ------------------------------------------------------------------------------------

    def begin_step(self, t0: float, t1: float) -> None:
        """Freeze what stays fixed during the step from t0 to t1 [s]; collective."""
        self.t0, self.t1, self.dt = t0, t1, t1 - t0
        self.new_iterate(None)
        after = self.scheme.stage_after(self.dt)
        changed = self.prescribed.begin_step(t0, t1)
        self._freeze(t0 + after)
        if changed or t0 in self._events:
            for follower in self.followers:
                follower.disturbed()
        asking = [follower for follower in self.followers if follower.needs_acceleration]
        acceleration = self.out_of_balance()[0] / self.mass[:, None] if asking else self.history
        for follower in asking:
            follower.start_from(acceleration)
        n = self.points.n_owned
        self.stage = stage = self.scheme.stage(self.x[:n], self.v[:n], self.dt)
        self.history = self.v[:n].copy() if stage.v is None else stage.v
        self._set_history(stage, t0 + after)
        self.anchored = clamped_energy(self.elastic, self.x)

    def _freeze(self, at: float) -> None:
        """Geometry, targets and loads that stay as they are at time ``at`` [s], the stage's."""
        n = self.points.n_owned
        for term in self.elastic:
            term.prepare(self.t0, self.t1, at)
        self._objectives, self._size = [], float(np.abs(self.x).max(initial=0.0))
        if self.scheme.moves or self.given_loads is None:
            self._load(at)
        else:
            self._force[:n] = self.given_loads
        if self._damping.acts:
            self._damping.freeze(self._frozen(at))

    def _frozen(self, at: float) -> Array:
        """Positions (n_local, 3) whose geometry stays as it is during the step."""
        return self.x + (at - self.t0) * self.v if self.scheme.centred else self.x

    def _load(self, at: float) -> None:
        """Loads that stay as they are during the step, and the wind's geometry."""
        n, t0, t1 = self.points.n_owned, self.t0, self.t1
        x = self._frozen(at) if self.viscous or self.loads else self.x
        self._force[:] = 0.0
        for load in self.loads:
            load.add_force(x, t0, t1, self._force)
        for wind in self.viscous:
            wind.freeze(x, self.v)
        if self.viscous and self.scheme.explicit:
            self._force[:n] -= self._sum(self.viscous, self.v)
        self._force[n:] = 0.0
        self._force *= self.load_factor
        if self.unbalanced is not None:
            self._force[:n] += (1.0 - self.load_factor) * self.unbalanced

    def _set_history(self, stage: Stage, at: float) -> None:
        """x_h with its ghosts, and the velocities of the prescribed coordinates."""
        n = self.points.n_owned
        given = bool(self.held) and self.scheme.given
        if stage.x is None and not given:
            self._xh = self.x
            self.prescribed.solve(self.x[:n], stage.reach)
            return
        self._xh = np.empty_like(self.x)
        self._xh[:n] = self.x[:n] if stage.x is None else stage.x
        if given:
            self.prescribed.give(at, self._xh[:n], stage.reach)
        else:
            self.prescribed.solve(self._xh[:n], stage.reach)
        self.points.update_ghosts(self._xh)

    @property
    def loads_now(self) -> Array:
        """The loads in force (n_owned, 3) [N]."""
        return self._force[: self.points.n_owned].copy()

    def out_of_balance(self) -> tuple[Array, float]:
        """Force (n_owned, 3) [N] on the free coordinates now, norm [N] of its largest part; collective."""
        parts = self._parts(self.x, self.v, np.zeros_like(self.history))
        return np.where(self.prescribed.free, -sum(parts.values()), 0.0), self.largest_force()

    @property
    def stage_velocity(self) -> Array:
        """Velocities (n_owned, 3) [m/s] of the stage of the step just accepted."""
        return self._vs[: self.points.n_owned]

    def prescribe(self, v: Array) -> None:
        """Overwrite the prescribed coordinates of v (n_owned, 3) by their velocities at the stage."""
        self.prescribed.put(v, self.prescribed.velocity)

    def velocity_of_staying(self) -> Array:
        """Velocities (n_owned, 3) [m/s] whose stage is where the step starts."""
        return ((self.x - self._xh) / self.stage.reach)[: self.points.n_owned]

    def accept(self, v: Array) -> None:
        """Take v (n_owned, 3) as the velocity of the stage and go to the end of the step; collective."""
        n, given, free = self.points.n_owned, self.scheme.given, self.prescribed.free
        self._evaluate_at(v)  # what the step's forces are taken at afterwards
        before, rate_before = self.x[:n].copy(), self.v[:n].copy()
        moved, rate = self.scheme.end(before, rate_before, v, self.dt)
        self.scheme.accepted(before, rate_before, free, self.dt)
        self.x[:n] = moved
        self.prescribed.put(self.x[:n], self.prescribed.goal)
        self.v[:n] = rate
        if given:
            self.prescribed.overwrite_with_rates(self.v[:n])
        for values in (self.x, self.v):
            self.points.update_ghosts(values)

    def written_velocity(self) -> Array:
        """Velocities (n_owned, 3) to write out: those of prescribed coordinates are ẋ*(t)."""
        self.prescribed.overwrite_with_rates(velocity := self.v[: self.points.n_owned].copy())
        return velocity

    @cached_property
    def _stiffnesses(self) -> list[Array]:
        return [term.force_scale(1.0)[: term.n_owned] for term in self.elastic]

    # -- what Newton asks for ----------------------------------------------------------------------

    def _evaluate_at(self, v: Array) -> tuple[Array, Array]:
        """Positions and velocities (n_local, 3) of the stage, ghosts up to date; collective."""
        self._vs[: self.points.n_owned] = v
        self.points.update_ghosts(self._vs)
        np.multiply(self._vs, self.stage.reach, out=self._xs)
        self._xs += self._xh
        return self._xs, self._vs

    def forces_at_stage(self) -> dict[str, Array]:
        """The parts of F at the stage of the step just accepted, each (n_owned, 3) [N]."""
        rate = self.stage.sigma * (self._vs[: self.points.n_owned] - self.history)
        parts, self._last_parts = self._parts(self._xs, self._vs, rate), {}
        return parts

    def _parts(self, x: Array, vs: Array, vdot: Array) -> dict[str, Array]:
        n, self._last_parts = self.points.n_owned, {}  # there is no room for both
        parts = {"inertia": self.mass[:, None] * vdot, "internal": self._internal(x)}
        if self._springs:
            parts["springs"] = self._sum(self._springs, x)
        parts["loads"] = -self._force[:n]
        if self._damping.acts:
            parts["damping"] = self._damping.product(vs)
        if self.viscous and not self.scheme.explicit:
            parts["wind"] = self._sum(self.viscous, vs)
        self._last_parts = parts
        return parts

    def _sum(self, terms: Sequence[Elastic | Viscous], at: Array) -> Array:
        self._gradient[:] = 0.0
        for term in terms:
            term.add_gradient(at, self._gradient)
        return self._gradient[: self.points.n_owned].copy()

    def residual(self, v: Array, vdot: Array, out: Array) -> None:
        """F (n_owned, 3) [N]; in prescribed coordinates σ m (v − v*); collective."""
        parts = self._parts(*self._evaluate_at(v), vdot).values()
        reduce(lambda total, part: np.add(total, part, out=out), parts)
        at, velocity = self.prescribed.at, self.prescribed.velocity
        self.prescribed.put(out, self.stage.sigma * self.mass[at // 3] * (v.take(at) - velocity))

    def largest_force(self) -> float:
        """Norm [N] of the largest part of F last evaluated, over the free coordinates; collective."""
        parts = (np.where(self.prescribed.free, part, 0.0) for part in self._last_parts.values())
        return float(np.sqrt(self.points.summed(*(float(np.vdot(p, p)) for p in parts)).max()))

    def new_iterate(self, v: Array | None) -> None:
        """Let Jacobians be those of Newton's iterate v, linearised from the one before; None: of the first.

        Its stress is then as independent as in a mixed method, and stiff sheets converge as soft ones do.
        """
        before = None if v is None else self._iterate
        self._iterate = None if v is None else self._evaluate_at(v)[0].copy()
        for term in self.elastic:
            term.linearise_from(before)

    def forget_rows(self) -> None:
        """Work no longer with the rows that ``jacobian`` was given, which their owner may free now."""
        self._damping.let_go()

    def jacobian(self, v: Array, blend: float, values: Array) -> None:
        """Let block rows (n_blocks, 3, 3) be σ M + c K + D + ∇∇P, prescribed coordinates decoupled.

        ``blend`` 0 takes the exact elastic Hessian, 1 the regularised one, between them a mixture.
        """
        x, vs = self._evaluate_at(v)
        self._last_parts = {} if self.scheme.explicit else self._last_parts
        for remembered in self._asked_once:  # the linear solve needs the room
            remembered.forget()
        inertia, reach, changing = self.stage.sigma * self.mass, self.stage.reach, self.prescribed.blocks
        if blend < 1.0 or not self._damping.with_stiffness_into(x, reach, inertia, values, changing):
            self._damping.into(values, inertia)
            for term in self.elastic:
                self._blocks.add_stiffness(term, x, blend, reach, values)
        if not self.scheme.explicit:
            for wind in self.viscous:
                self._blocks.add_viscosity(wind, vs, values)
        if len(self.prescribed.rows):
            self._blocks.constrain(values, self.prescribed.mask, self.prescribed.rows)

    def objective(self, v: Array) -> tuple[float, float]:
        """The function whose gradient F is, and what its round-off is relative to [W].

        Collective. The latter is the size of its summands, and for each elastic energy the root of itself
        times the energy at which strains are of order one: small strains are small differences of large
        coordinates.
        """
        if self._objectives:
            # a line search ends, and a first guess begins, where it was asked for already
            same = np.array([int(np.array_equal(v, at)) for at, _ in self._objectives])
            self.points.comm.Allreduce(MPI.IN_PLACE, same, MPI.MIN)
            if same.any():
                return self._objectives[int(same.argmax())][1]
        result = self._objective(v)
        self._objectives = [*self._objectives[-1:], (v.copy(), result)]
        return result

    def _objective(self, v: Array) -> tuple[float, float]:
        n, sigma, rate = self.points.n_owned, self.stage.sigma, 1.0 / self.stage.reach
        x, vs = self._evaluate_at(v)
        change = v - self.history
        parts, square = [0.5 * sigma * float(np.sum(self.mass[:, None] * change * change))], 0.0
        for term, stiffness in zip(self.elastic, self._stiffnesses, strict=True):
            each = term.energies(x)
            parts.append(rate * float(each.sum()))
            square += 2.0 * (rate * self._size) ** 2 * float(np.vdot(each, stiffness))
        parts.append(-rate * float(np.vdot(self._force[:n], x[:n] - self.x[:n])))
        if self._damping.acts:
            parts.append(0.5 * float(np.vdot(v, self._damping.product(vs))))
        if not self.scheme.explicit:
            parts += [float(wind.potentials(vs).sum()) for wind in self.viscous]
        value, size, square = self.points.summed(sum(parts), sum(abs(part) for part in parts), square)
        return float(value), float(size) + float(np.sqrt(square))
