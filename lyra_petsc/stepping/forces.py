"""The equations F(v) = 0 of a step's stage, as functions of an `Evaluation`: F, its Jacobian and objective.

Unknown v (the velocity of the integrator's stage), with its history x_h, v_h and numbers σ, c::

    F(v, v̇) = M v̇ + ∇E(x_h + c v) + D v + ∇P(v) − f,  v̇ = σ (v − v_h)       Jacobian  σ M + c K + D + ∇∇P

with the elastic energy E, damping D = γ K⁺, the wind's potential P and the loads f. F is the gradient of the
objective. Backward Euler has x_h = x_n, v_h = v_n, σ = 1/c = 1/Δt: the Lyra paper, eq. 10-18, as a Newton
iteration. The geometry of D, P and f is frozen during a step: at x_n for first-order integrators, at the
extrapolated stage x_n + (t_s − t_n) v_n for second-order ones.

Unknowns of edges have no mass: their rows of F are ∂E/∂φ, and they are in equilibrium at the stage.

This module works on arrays only, without PETSc. Methods that return sums over ranks are collective.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.linear.block_rows import ConstrainedEntries, squared_norm_without
from lyra_petsc.linear.discretisation import Discretisation
from lyra_petsc.linear.low_rank import LowRank
from lyra_petsc.mesh.points import Layout
from lyra_petsc.stepping.active_terms import ActiveTerms, Frozen, gradient
from lyra_petsc.stepping.damping import Damping
from lyra_petsc.stepping.prescribed import PrescribedUnknowns
from lyra_petsc.stepping.state import kinetic_energy
from lyra_petsc.stepping.time_step import Evaluation, TimeStep
from lyra_petsc.terms.protocols import LimitsStep
from lyra_petsc.terms.term import Elastic, Term, Viscous


class StageForces:
    """One rank's part of the equations.

    Parameters
    ----------
    discretisation : Discretisation
    mass : (n_owned,) [kg]
        Mass of each block row: the lumped mass of a vertex, 0 for an edge.
    active : ActiveTerms
    damping : Damping
    edge_stiffness : (n,)
        Stiffness [N/m] that Jacobians add to the diagonal of the block rows of edges.
    """

    def __init__(
        self,
        discretisation: Discretisation,
        mass: Array,
        active: ActiveTerms,
        damping: Damping,
        edge_stiffness: Array,
    ) -> None:
        self._discretisation, self.mass, self.active = discretisation, mass, active
        self._damping, self._edge_stiffness = damping, edge_stiffness
        self._squares: list[float] = []
        self._constrained: tuple[int, ConstrainedEntries] | None = None

    @property
    def layout(self) -> Layout:
        """Layout of the local rows."""
        return self._discretisation.layout

    def sum(self, terms: Sequence[Elastic | Viscous], at: Array, frozen: Frozen) -> Array:
        """Gradient (n_owned, 3) [N] of the sum of ``terms`` at positions or velocities (n_local, 3)."""
        return gradient(terms, at, frozen, self.layout)

    @property
    def damps(self) -> bool:
        """Whether any term is damped."""
        return self._damping.active

    # -- F -----------------------------------------------------------------------------------------

    def parts(self, at: Evaluation, rate: Array) -> Iterator[tuple[str, Array]]:
        """Names and values (n_owned, 3) [N] of the parts of F with accelerations ``rate`` (n_owned, 3).

        They are generated one by one, because all of them together take much memory. Internal forces come
        last, because terms keep data of them, which take memory, too.
        """
        step, active, self._squares = at.step, self.active, []
        yield self._with_square(step, "inertia", self.mass[:, None] * rate)
        del rate
        springs = [term for term in active.external if term not in active.sliding]
        for name, terms in (("springs", springs), ("friction", active.sliding)):
            if terms:
                yield self._with_square(step, name, self.sum(terms, at.x, at.frozen))
        yield self._with_square(step, "loads", -step.loads.force_at(at.x))
        if self.damps:
            yield self._with_square(step, "damping", at.damping)
        if active.viscous and not step.lagged:
            yield self._with_square(step, "wind", self.sum(active.viscous, at.v, at.frozen))
        if active.summing:  # such as a pressure that the sheet's own forces balance
            yield self._with_square(step, "filling", self.sum(active.summing, at.x, at.frozen))
        yield self._with_square(step, "internal", at.internal)

    def internal(self, at: Evaluation) -> Array:
        """Forces (n_owned, 3) [N] of the sheet, without what fills it."""
        own = [term for term in self.active.sheet if term not in self.active.summing]
        return self.sum(own, at.x, at.frozen)

    def damping(self, at: Evaluation) -> Array:
        """Forces (n_owned, 3) [N] of material damping."""
        return self._damping.product(at.v)

    def _with_square(self, step: TimeStep, name: str, part: Array) -> tuple[str, Array]:
        """The part of F, after its square is kept for `largest_force`."""
        self._squares.append(squared_norm_without(part.reshape(-1), step.prescribed.not_counted))
        return name, part

    def total(self, at: Evaluation, rate: Array, out: Array) -> Array:
        """F (n_owned, 3) [N], written to ``out``."""
        out[:] = 0.0
        for _, part in self.parts(at, rate):
            out += part
            del part
        return out

    def residual(self, v: Array, at: Evaluation, out: Array) -> None:
        """Write F (n_owned, 3) [N] at velocities v (n_owned, 3), linearised ``at`` a stage, to ``out``, in
        rows of prescribed unknowns σ m (v − v*).
        """
        step, held = at.step, at.step.prescribed
        self.total(at, step.stage.sigma * (v - step.v_h), out)
        weight = step.stage.sigma * self.mass[held.indices // 3]
        held.overwrite(out, weight * (v.take(held.indices) - held.velocity))

    def largest_force(self) -> float:
        """Norm [N] of the largest part of F last computed, over the free unknowns; collective."""
        return float(np.sqrt(self.layout.global_sum(*self._squares).max(initial=0.0)))

    def out_of_balance(self, at: Evaluation) -> Array:
        """Force (n_owned, 3) [N] on the free unknowns without inertia."""
        total = self.total(at, np.zeros((len(self.mass), 3)), np.empty((len(self.mass), 3)))
        return np.where(at.step.prescribed.free, -total, 0.0)

    # -- objective ---------------------------------------------------------------------------------

    def objective(self, at: Evaluation) -> tuple[float, float]:
        """As `Evaluation.objective`; collective.

        The scale is the sum of the absolute summands and of the geometric mean of each elastic energy and the
        energy at which strains are of order one: small strains are small differences of large coordinates.
        """
        step, n = at.step, len(self.mass)
        rate, v, frozen = 1.0 / step.stage.c, at.v[:n], at.frozen
        parts, square = [step.stage.sigma * kinetic_energy(self.mass, v - step.v_h)], 0.0
        for term in self.active.elastic:
            if not term.n_elements:
                continue
            energies = term.energies(at.x, frozen[term])
            parts.append(rate * float(energies.sum()))
            of_size: float | Array = rate * step.size
            if isinstance(term, LimitsStep):
                stiffness = term.stiffness(at.x, frozen[term])[: term.n_owned]
                sizes = term.coordinate_scale(step.size)
                of_size = rate * (sizes if isinstance(sizes, float) else sizes[: term.n_owned])
            elif term in self.stiffnesses:
                stiffness = self.stiffnesses[term]
            else:
                stiffness = term.force_scale(1.0)[: term.n_owned]
            # `**` would raise an error where the square is infinite
            square += 2.0 * abs(float(np.vdot(energies, stiffness * (of_size * of_size))))
        parts.append(-rate * float(np.vdot(step.loads.force, at.x[:n] - step.x[:n])))
        if step.loads.following is not None:
            parts.append(rate * step.loads.following.energy(at.x))
        if self.damps:
            parts.append(0.5 * float(np.vdot(v, at.damping)))
        if not step.lagged:
            parts += [float(wind.potentials(at.v, frozen[wind]).sum()) for wind in self.active.viscous]
        value, size, square = self.layout.global_sum(sum(parts), sum(map(abs, parts)), square)
        return float(value), float(size) + float(np.sqrt(square))

    @cached_property
    def stiffnesses(self) -> dict[Term, Array]:
        """Force over displacement [N/m] of the owned elements of each term for which it is constant."""
        elastic = self.active.elastic
        constant = [t for t in elastic if not (t.registration.of_contact or isinstance(t, LimitsStep))]
        return {term: term.force_scale(1.0)[: term.n_owned] for term in constant}

    # -- Jacobian ----------------------------------------------------------------------------------

    def jacobian(
        self, at: Evaluation, convexity: float, values: Array, predicted: tuple[Array, Array] | None = None
    ) -> Array | None:
        """Write σ M + c K + D + ∇∇P to block rows (n_blocks, 3, 3), prescribed unknowns decoupled.

        ``convexity`` is the weight of the regularised elastic Hessian: 0 takes the exact one. For
        ``predicted`` see `Assembly`; it may have other ghosts than the stage, but of contact only: those of
        fixed stencils are the first. Returns the change (n_owned, 3) [N] of F by the motion of prescribed
        unknowns in steps of one linear solve, or None.
        """
        step, rows, reach = at.step, self._discretisation.rows, at.step.stage.c
        inertia = step.stage.sigma * self.mass
        if len(self._edge_stiffness):
            inertia[len(inertia) - len(self._edge_stiffness) :] += reach * self._edge_stiffness
        constrained = self.constrained(step.prescribed)
        changing = constrained.changed
        whole = step.linear and convexity == 1.0
        if not (whole and self._damping.assemble_with_stiffness(reach, inertia, values, changing)):
            self._damping.assemble(values, inertia)
            for term in self.active.elastic:
                rows.add_stiffness(term, at.x, at.frozen[term], convexity, reach, values, predicted)
        if not step.lagged:
            for wind in self.active.viscous:
                wind.add_hessian(at.v, at.frozen[wind], rows.pattern.offsets, values)
        if step.loads.following is not None and convexity < 1.0:
            step.loads.following.add_hessian((1.0 - convexity) * reach, rows.pattern, values)
        force = self._force_of_prescribed(at, values) if step.linear else None
        if len(changing):
            rows.constrain(values, step.prescribed.mask, constrained)
        return force

    def dense_part(self, at: Evaluation) -> LowRank | None:
        """The part of the Jacobian that is not in block rows, with prescribed unknowns; collective."""
        terms = self.active.summing
        if not terms:
            return None
        weights, vectors = zip(*(term.dense_hessian(at.x, at.frozen[term]) for term in terms), strict=True)
        owned = np.concatenate(vectors)[:, : len(self.mass)]
        return LowRank(self.layout, at.step.stage.c * np.concatenate(weights), owned)

    def constrained(self, prescribed: PrescribedUnknowns) -> ConstrainedEntries:
        """Entries of the present matrix in rows and columns of prescribed unknowns."""
        if self._constrained is None or self._constrained[0] != prescribed.number:
            entries = self._discretisation.rows.constrained_entries(prescribed.mask)
            self._constrained = prescribed.number, entries
        return self._constrained[1]

    def forget_pattern(self) -> None:
        """The matrix has other entries."""
        self._constrained = None

    def _force_of_prescribed(self, at: Evaluation, values: Array) -> Array | None:
        """The product (n_owned, 3) [N] of the Jacobian ``values``, before prescribed unknowns are decoupled,
        with the velocities of these; 0 in their rows. None if none moves; collective.
        """
        prescribed = at.step.prescribed
        increment = np.zeros((len(self.mass), 3))
        prescribed.overwrite(increment, prescribed.velocity)
        if not any(self.layout.global_max(bool(increment.any()))):
            return None
        product = self._discretisation.rows.product(values, self.layout.extended(increment))
        if (dense := self.dense_part(at)) is not None:
            product += dense.product(increment)
        return np.where(prescribed.free, product, 0.0)
