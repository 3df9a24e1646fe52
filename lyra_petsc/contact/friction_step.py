"""Friction in the equations of a step, at its start and at its end, as values."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array, Ints, Mask
from lyra_petsc.contact import friction_pairs
from lyra_petsc.contact.body_motions import BodyMotions
from lyra_petsc.contact.contact_setup import HALFWAY_CURVATURE
from lyra_petsc.contact.obstacle_points import obstacle_loads
from lyra_petsc.contact.pairs import FrictionPairs, Rows, chosen

MAX_ELASTIC_SLIP = 0.01
"""Largest slip of a sticking pair over the gap. If the kinetic coefficient is below the static one, all pairs
have this elastic slip: if lightly pressed pairs, such as those at a sheet's border, slid before the others,
the sheet would slide too early. Otherwise lightly pressed pairs have a shorter one, because they have to
build it up again whenever they separate and come back."""

SHEET_SOFTNESS = 0.25
"""Friction stiffness between sheets over that on obstacles, for lightly pressed pairs. With springs as stiff
as the barrier halfway through the gap sheets rotate by much, and Newton's method needs up to 1.4 times as
many iterations."""


def moved_pairs(pairs: FrictionPairs, motions: BodyMotions) -> FrictionPairs:
    """The pairs after the obstacles have moved, if they stick: contact points move with them, and their slip
    turns.
    """
    moving = [number for number in np.unique(pairs.obstacle) if number >= 0 and motions.moves(number)]
    if not moving:
        return pairs
    slip, start, contact_point = pairs.slip.copy(), pairs.start.copy(), pairs.contact_point.copy()
    for obstacle in moving:
        rows = np.flatnonzero(pairs.obstacle == obstacle)
        side, place = pairs.beta[rows].sum(axis=1), pairs.contact_point[rows]
        contact_point[rows], rotation = motions.carried(obstacle, place, pairs.body_points[rows])
        slip[rows] = np.einsum("eij,ej->ei", rotation, pairs.slip[rows])
        displacement = side[:, None] * (contact_point[rows] - place)
        start[rows] += np.einsum("eck,ek->ec", pairs.tangents[rows], displacement)
    return pairs._replace(slip=slip, start=start, contact_point=contact_point)


class StepFriction(NamedTuple):
    """The friction of all pairs with a vertex of this rank.

    Attributes
    ----------
    rows : (E, 4) int32
        Local rows of the vertices.
    pairs : FrictionPairs
    stiffness, limit : (E,)
        k [N/m] and μ N [N].
    n_counted : int
        Number of the first pairs, which this rank counts.
    offset : (E, 2)
        Relative displacement [m] along the tangents of vertices at the origin.
    """

    rows: Rows
    pairs: FrictionPairs
    stiffness: Array
    limit: Array
    n_counted: int
    offset: Array

    @property
    def kernel_data(self) -> tuple[NDArray[Any], ...]:
        """Arguments of the kernels (`friction_pairs`)."""
        return self.rows, self.pairs.gradients, self.offset, self.stiffness, self.limit

    def with_pairs(self, pairs: FrictionPairs) -> StepFriction:
        """The friction of these pairs after a motion."""
        return self._replace(pairs=pairs, offset=pairs.along(pairs.slip) - pairs.start)

    def moved(self, motions: BodyMotions) -> StepFriction:
        """The friction after the obstacles have moved."""
        pairs = moved_pairs(self.pairs, motions)
        return self if pairs is self.pairs else self.with_pairs(pairs)

    def counted(self) -> StepFriction:
        """That of the pairs which this rank counts."""
        n = slice(self.n_counted)
        pairs, of_pairs = chosen(self.pairs, n), (self.stiffness[n], self.limit[n])
        return StepFriction(self.rows[n], pairs, *of_pairs, self.n_counted, self.offset[n])

    def slid(self, x: Array) -> tuple[StepFriction, Array]:
        """The friction with the elastic slip at x (n_local, 3), and the heat (E,) [J] of sliding."""
        slip, heat = self.pairs.slip.copy(), np.empty(len(self.rows))
        slides = np.empty(len(heat), dtype=np.bool_)
        friction_pairs.return_map(x, *self.kernel_data, self.pairs.tangents, slip, heat, slides)
        return self._replace(pairs=self.pairs._replace(slip=slip, slides=slides)), heat

    def elastic_force(self) -> Array:
        """Friction (E, 2) [N] of the elastic slip along the tangents, opposite to it."""
        return -self.stiffness[:, None] * self.pairs.along(self.pairs.slip)

    def loads(self, x: Array) -> tuple[Ints, Array]:
        """Numbers of obstacles and loads (m, 8) on them by `elastic_force`, as `obstacle_loads`."""
        pairs, friction = self.pairs, self.elastic_force()
        force = np.einsum("ec,eck->ek", friction, pairs.tangents)
        size = np.column_stack([np.zeros(len(friction)), np.linalg.norm(friction, axis=1)])
        return obstacle_loads(x, self.rows, pairs.beta, pairs.obstacle, force, size)


def step_friction(
    rows: NDArray[np.int32], pairs: FrictionPairs, n_counted: int, coefficients: Array, gap: float
) -> StepFriction:
    """The friction of pairs with the static and kinetic ``coefficients`` (obstacles + 1, 2); the last are
    those between sheets. ``gap`` [m] is the barrier's.
    """
    static, kinetic = coefficients[pairs.obstacle].T
    limit = np.where(pairs.slides, kinetic, static) * pairs.force
    softness = np.where(pairs.obstacle < 0, SHEET_SOFTNESS, 1.0)
    largest = limit / (MAX_ELASTIC_SLIP * gap)
    stiffness = np.maximum(softness * HALFWAY_CURVATURE * pairs.stiffness, largest)
    yields = static * pairs.force / (MAX_ELASTIC_SLIP * gap)
    stiffness = pairs.factor * np.where(kinetic < static, yields, stiffness)
    offset = pairs.along(pairs.slip) - pairs.start
    return StepFriction(rows, pairs, stiffness, pairs.factor * limit, n_counted, offset)


def work_of_obstacles(ends: tuple[Array, Array], friction: tuple[StepFriction, StepFriction]) -> float:
    """Work [J] of moving obstacles on the pairs that this rank counts in a step between the positions
    ``ends`` (n_local, 3), with the friction after the obstacles' motion to both.
    """
    # by forces: an obstacle moves by many times the elastic slip, so that energies would not do
    slip, force, energy = [], [], []
    for x, step in zip(ends, friction, strict=True):
        u = step.pairs.displacement(x[step.rows]) + step.offset
        secant = np.minimum(step.stiffness, step.limit / np.maximum(np.linalg.norm(u, axis=1), 1e-300))
        friction_pairs.energies(x, *step.kernel_data, stored := np.empty(len(u)))
        slip.append(u)
        force.append(secant[:, None] * u)
        energy.append(stored)
    # the mean of the forces, with that part along the slip by which they do the work that is stored or lost:
    # from rest, friction reaches its limit long before the end of the step
    mean, along = 0.5 * (force[0] + force[1]), slip[1] - slip[0]
    missing = energy[1] - energy[0] - np.einsum("ec,ec->e", mean, along)
    square, of_both = (along * along).sum(axis=1), sum((u * u).sum(axis=1) for u in slip)
    # shorter slip is round-off
    mean += (missing / np.maximum(square, np.maximum(1e-16 * of_both, 1e-300)))[:, None] * along
    return float(np.vdot(mean, friction[1].offset - friction[0].offset))


class StartingFriction(NamedTuple):
    """Friction of the counted pairs at the start of a step, in two tangential components.

    Attributes
    ----------
    step : StepFriction
    force : (m, 2)
        Friction of the elastic slip, opposite to it [N].
    moved : (m, 2)
        Relative displacement in the step by the motion of the obstacle alone [m].
    """

    step: StepFriction
    force: Array
    moved: Array


class EndFriction(NamedTuple):
    """Friction of the counted pairs in the equations of a step, and its limits at the end of the step.

    Attributes
    ----------
    rows : (m, 4)
        Local rows of the vertices.
    pairs : FrictionPairs
        Those at the end, with the normal forces [N] of the step, and those in the equations of the step,
        whose normal forces are 0: the pairs at the end follow them.
    force, applied : (m, 2)
        Friction [N] along the tangents with which a pair of the end begins, and that in the equations.
    static, kinetic : (m,)
        Largest friction [N] of sticking pairs, and of sliding ones.
    holds : (m,)
        Whether the pair sticks in the equations of the step, with less friction than the static one.
    velocity : (m, 2)
        Velocities [m/s] of obstacles along the tangents, times Σ β_i.
    still : float
        Displacement [m] in a step up to which a sticking pair counts as at rest.
    """

    rows: Ints
    pairs: FrictionPairs
    force: Array
    applied: Array
    static: Array
    kinetic: Array
    holds: Mask
    velocity: Array
    still: float
