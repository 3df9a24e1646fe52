"""The reduced implicit system of one step: residual, Jacobian and objective in the velocities.

Unknown v (the velocity of the step), x = x_n + v/σ with σ the shift of the time scheme::

    F(v, v̇) = M v̇ + ∇E(x_n + v/σ) + D v + ∇P(v) − f        Jacobian  σ M + K/σ + D + ∇∇P

with the elastic energy E, damping D = γ K⁺(x_n), the wind's potential P and the loads f. For backward
Euler it is the gradient of ``objective``. Source: the Lyra paper, eq. 10-18, as a Newton iteration.

Arrays only: no PETSc here. Collective where sums over ranks are returned.
"""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.assembly.blocks import BlockRows
from lyra_petsc.handles.held import Held
from lyra_petsc.partition.points import Points
from lyra_petsc.terms.term import Elastic, Load, Viscous

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class ReducedSystem:
    """One rank's part of the system, and the state (x_n, v_n) it starts a step from.

    Parameters
    ----------
    points : Points
    mass : (n_owned,) [kg]
    elastic, viscous, loads : lists of terms
    held : Held
    blocks : BlockRows
    starts : list of float
        Times [s] at which handles start to act.
    explicit_wind : bool
        Velocity-dependent loads at (x_n, v_n) instead of implicitly (``semi-implicit``).

    Attributes
    ----------
    x, v : (n_local, 3)
        Positions [m] and velocities [m/s] at the start of the step, ghosts up to date.
    mask : (n_local, 3) bool
        Prescribed coordinates of the step.
    anchored : float
        Energy [J] of this rank's clamps at the start of the step, against where they stand at its end.
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
        starts: list[float],
        explicit_wind: bool,
    ) -> None:
        self.points, self.mass = points, mass
        self.elastic, self.viscous, self.loads, self.held = elastic, viscous, loads, held
        self._blocks = blocks
        self._starts = sorted(set(starts))
        self._begun: set[float] = set()
        self.late_starts: dict[float, Array] = {}
        self._explicit = explicit_wind
        self._springs = [term for term in elastic if term.name == "spring"]
        self._shell = [term for term in elastic if term.name != "spring"]
        self._damped = [t for t in elastic if t.damped and np.any(t.elements.data["damping"])]
        self.damped = bool(points.comm.allreduce(len(self._damped), MPI.MAX))
        self._damping = blocks.zeros() if self.damped else None
        self._values = blocks.zeros()
        n_local, n_owned = points.n_local, points.n_owned
        self.x, self.v = np.zeros((n_local, 3)), np.zeros((n_local, 3))
        self._xs, self._vs, self._gradient = (np.zeros((n_local, 3)) for _ in range(3))
        self._force = np.zeros((n_local, 3))
        self.mask: Mask = np.zeros((n_local, 3), dtype=bool)
        self._free: Mask = ~self.mask[:n_owned]
        self._held_rows = np.empty(0, dtype=np.int64)
        self._prescribed = np.zeros((n_owned, 3))
        self._goal = np.zeros((n_owned, 3))
        self._active: tuple[int, ...] | None = None
        self.anchored = 0.0
        self._energy_scales: list[Array] = []
        self.dt = 0.0
        self.t0 = self.t1 = 0.0

    def begin(self, time: float) -> None:
        """Let everything that starts to act by ``time`` [s] set out from the present positions."""
        for start in self.starts():
            if start <= time and start not in self._begun:
                self._begun.add(start)
                if start > 0.0:
                    self.late_starts[start] = self.x[: self.points.n_owned].copy()
                self._set_out(start, self.x)

    def resume(self, start: float, x: Array) -> None:
        """Let what started at ``start`` [s] set out from positions x (n_owned, 3); collective."""
        shape = np.zeros((self.points.n_local, 3))
        shape[: self.points.n_owned] = x
        self.points.update_ghosts(shape)
        self._begun.add(start)
        self.late_starts[start] = shape[: self.points.n_owned].copy()
        self._set_out(start, shape)

    def _set_out(self, start: float, x: Array) -> None:
        self.held.begin(start, x)
        for term in self.elastic:
            term.begin(start, x)

    def starts(self) -> list[float]:
        """Times at which handles start, ascending."""
        return self._starts

    # -- a step ------------------------------------------------------------------------------------

    def begin_step(self, t0: float, t1: float) -> None:
        """Freeze what stays fixed during the step from t0 to t1 [s]; collective."""
        self.t0, self.t1, self.dt = t0, t1, t1 - t0
        n = self.points.n_owned
        self._constrain(t0, t1)
        for term in self.elastic:
            term.prepare(t0, t1)
        self.anchored = sum(float(t.energies(self.x).sum()) for t in self.elastic if t.name == "clamp")
        reach = float(np.abs(self.x).max(initial=0.0))
        self._energy_scales = [reach * term.force_scale(reach)[: term.n_owned] for term in self.elastic]
        self._force[:] = 0.0
        for load in self.loads:
            load.add_force(self.x, t0, t1, self._force)
        for wind in self.viscous:
            wind.freeze(self.x, self.v)
            if self._explicit:
                push = np.zeros_like(self._force)
                wind.add_gradient(self.v, push)
                self._force -= push
        self._force[n:] = 0.0
        if self._damping is not None:
            self._damping[:] = 0.0
            for damped in self._damped:
                self._add_stiffness(damped, self.x, 1.0, damped.elements.data["damping"], self._damping)

    def _constrain(self, t0: float, t1: float) -> None:
        n = self.points.n_owned
        if not self.held:
            return
        active = self.held.active(t0, t1)
        if active != self._active:
            self._active = active
            # ranks own different vertices of a handle, but all agree on which handles hold
            flags = np.zeros((self.points.n_local, 3))
            flags[:n] = self.held.mask(t0, t1, n)
            self.points.update_ghosts(flags)
            self.mask = flags > 0.5
            self._free = ~self.mask[:n]
            self._held_rows = self._blocks.rows_beside(self.mask)
        self._goal[:] = self.x[:n]
        self.held.targets(t0, t1, self._goal)
        self._prescribed = np.where(self._free, 0.0, (self._goal - self.x[:n]) / self.dt)

    def first_guess(self, v: Array) -> None:
        """Overwrite v (n_owned, 3) by where Newton starts: prescribed coordinates exactly."""
        if self._explicit:
            v[:] = 0.0
        np.copyto(v, self._prescribed, where=~self._free)

    def accept(self, v: Array) -> None:
        """Take v (n_owned, 3) as the velocity of the step: x_{n+1} = x_n + Δt v; collective."""
        n = self.points.n_owned
        moved = self.x[:n] + self.dt * v
        self.x[:n] = np.where(self._free, moved, self._goal)
        self.v[:n] = v
        self.points.update_ghosts(self.x)
        self.points.update_ghosts(self.v)

    def written_velocity(self) -> Array:
        """Velocities (n_owned, 3) to write out: those of prescribed coordinates are ẋ*(t)."""
        velocity = self.v[: self.points.n_owned].copy()
        if self.held and self.dt > 0.0:
            self.held.velocities(self.t0, self.t1, velocity)
        return velocity

    # -- what Newton asks for ----------------------------------------------------------------------

    def _stage(self, v: Array, sigma: float) -> tuple[Array, Array]:
        """Positions and velocities (n_local, 3) of the stage, ghosts up to date; collective."""
        n = self.points.n_owned
        self._vs[:n] = v
        self.points.update_ghosts(self._vs)
        np.multiply(self._vs, 1.0 / sigma, out=self._xs)
        self._xs += self.x
        return self._xs, self._vs

    def forces(self, v: Array, vdot: Array, sigma: float) -> dict[str, Array]:
        """The parts of F, unconstrained, each (n_owned, 3) [N]; collective."""
        x, vs = self._stage(v, sigma)
        return self._parts(x, vs, vdot)

    def forces_at_end(self, vdot: Array) -> dict[str, Array]:
        """The parts of F at the state (x, v) just accepted, each (n_owned, 3) [N]."""
        return self._parts(self.x, self.v, vdot)

    def _parts(self, x: Array, vs: Array, vdot: Array) -> dict[str, Array]:
        n = self.points.n_owned
        parts = {"inertia": self.mass[:, None] * vdot}
        for name, terms in (("internal", self._shell), ("springs", self._springs)):
            if terms:
                self._gradient[:] = 0.0
                for term in terms:
                    term.add_gradient(x, self._gradient)
                parts[name] = self._gradient[:n].copy()
        parts["loads"] = -self._force[:n]
        if self._damping is not None:
            parts["damping"] = self._blocks.product(self._damping, vs)
        if self.viscous and not self._explicit:
            self._gradient[:] = 0.0
            for wind in self.viscous:
                wind.add_gradient(vs, self._gradient)
            parts["wind"] = self._gradient[:n].copy()
        return parts

    def residual(self, v: Array, vdot: Array, sigma: float, out: Array) -> None:
        """F (n_owned, 3) [N]; in prescribed coordinates σ m (v − v*); collective."""
        parts = self.forces(v, vdot, sigma)
        total = sum(parts.values())
        held = (sigma * self.mass)[:, None] * (v - self._prescribed)
        out[:] = np.where(self._free, total, held)
        self.force_norms = {name: self._norm(part) for name, part in parts.items()}

    def _norm(self, part: Array) -> float:
        """Square of the norm over this rank's free coordinates."""
        return float(np.sum(part * part, where=self._free))

    def jacobian(self, v: Array, sigma: float, blend: float) -> Array:
        """Block rows (n_blocks, 3, 3) of σ M + K/σ + D + ∇∇P, prescribed coordinates decoupled.

        ``blend`` 0 takes the exact elastic Hessian, 1 the regularised one, between them a mixture.
        """
        x, vs = self._stage(v, sigma)
        values = self._values
        if self._damping is not None:
            values[:] = self._damping
        else:
            values[:] = 0.0
        for term in self.elastic:
            self._add_stiffness(term, x, blend, 1.0 / sigma, values)
        if not self._explicit:
            for wind in self.viscous:
                self._add_wind(wind, vs, values)
        self._blocks.add_diagonal(sigma * self.mass, values)
        if len(self._held_rows):
            self._blocks.constrain(values, self.mask, self._held_rows)
        return values

    def _add_stiffness(
        self, term: Elastic, x: Array, blend: float, weight: Array | float, values: Array
    ) -> None:
        self._blocks.add(term.name, lambda lo, hi, out: term.hessians(x, lo, hi, blend, out), weight, values)

    def _add_wind(self, wind: Viscous, v: Array, values: Array) -> None:
        self._blocks.add(wind.name, lambda lo, hi, out: wind.hessians(v, lo, hi, out), 1.0, values)

    def objective(self, v: Array, sigma: float) -> tuple[float, float]:
        """The function whose gradient F is (backward Euler), and what its round-off is relative to [W].

        Collective. The latter is the size of its summands, and for each elastic energy the root of itself
        times the energy at which strains are of order one: small strains are small differences of large
        coordinates.
        """
        n = self.points.n_owned
        x, vs = self._stage(v, sigma)
        change = v - self.v[:n]
        inertia = 0.5 * sigma * float(np.sum(self.mass[:, None] * change * change))
        energies, square = [], 0.0
        for term, scale in zip(self.elastic, self._energy_scales, strict=True):
            each = term.energies(x)
            energies.append(float(each.sum()))
            square += 2.0 * float(np.vdot(each, scale))
        work = float(np.vdot(self._force[:n], x[:n] - self.x[:n]))
        parts = [inertia, *(sigma * e for e in energies), -sigma * work]
        if self._damping is not None:
            parts.append(0.5 * float(np.vdot(v, self._blocks.product(self._damping, vs))))
        if not self._explicit:
            parts += [float(wind.potentials(vs).sum()) for wind in self.viscous]
        local = np.array([sum(parts), sum(abs(part) for part in parts), sigma * sigma * square])
        value, size, square = self.points.comm.allreduce(local)
        return float(value), float(size) + float(np.sqrt(square))

    def roundoff(self, size: float) -> float:
        """Norm [N] that round-off alone may give the residual: 10 ε of the internal force scale.

        ``size`` [m] is the largest coordinate: differences of such numbers make the strains.
        """
        scale = np.zeros(self.points.n_local)
        for term in self.elastic:
            amount = np.repeat(term.force_scale(size), term.stencil.shape[1])
            scale += np.bincount(term.stencil.ravel(), amount, self.points.n_local)
        square = float(np.sum(scale[: self.points.n_owned] ** 2))
        return 10.0 * float(np.finfo(float).eps) * float(np.sqrt(self.points.comm.allreduce(square)))
