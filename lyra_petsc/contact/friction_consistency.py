"""How far the friction of an equilibrium is from what its normal forces allow."""

from __future__ import annotations

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.contact.body_motions import BodyMotions
from lyra_petsc.contact.friction_step import StepFriction
from lyra_petsc.contact.obstacle_points import Obstacles
from lyra_petsc.contact.pairs import Contacts, Rows

TINY = np.finfo(float).tiny


def friction_lag(step: StepFriction, contacts: Contacts, n_vertices: int, count: int) -> Array:
    """How far friction, with the elastic slip of the ``step``, is from the limit of the normal forces of
    ``contacts``.

    For each of ``count`` obstacles, and last between sheets, three sums [N] over the vertices of this rank's
    pairs: error (friction beyond the limit, or below it where pairs slide), friction, limit, (count, 3).
    """
    pairs, friction = step.pairs, np.linalg.norm(step.elastic_force(), axis=1)

    def by_vertex(rows: Rows, obstacle: Ints, size: Array) -> Array:
        bins, n_bins = rows[:, 0].astype(np.int64) * count + obstacle % count, n_vertices * count
        return np.bincount(bins, size, n_bins).reshape(-1, count).astype(np.float64)

    acting = by_vertex(contacts.rows, contacts.obstacle, contacts.force)
    sizes = pairs.force, step.limit, friction, np.where(pairs.slides, friction, 0.0)
    taken, limit, friction, sliding = (by_vertex(step.rows, pairs.obstacle, size) for size in sizes)
    ratio = acting / np.maximum(taken, TINY)
    error = np.maximum(friction - ratio * limit, np.maximum(ratio - 1.0, 0.0) * sliding)
    return np.stack([error.sum(axis=0), friction.sum(axis=0), (ratio * limit).sum(axis=0)], axis=1)


def slip_under_changed_forces(
    x: Array,
    dx: Array,
    step: StepFriction,
    contacts: Contacts,
    obstacles: Obstacles,
    motions: BodyMotions,
    n_vertices: int,
) -> tuple[float, float]:
    """How far points slip while normal forces change, in a solve by dx (n_local, 3) [m] to x.

    Two sums over the vertices of this rank's pairs: slip times the change of the normal force from the
    ``step`` to the ``contacts`` [J], and the larger of the two normal forces [N].
    """

    def by_vertex(rows: Rows, force: Array, slip: Array) -> tuple[Array, Array]:
        total = np.bincount(rows[:, 0], force, n_vertices).astype(np.float64)
        moment = np.bincount(rows[:, 0], force * np.linalg.norm(slip, axis=1), n_vertices)
        return total, moment / np.maximum(total, TINY)

    beta, normal = contacts.sheet_beta, contacts.normal
    moved = obstacles.contact_displacements(
        x, contacts.rows, beta, contacts.obstacle, contacts.points, motions
    )
    slip = np.einsum("ei,eik->ek", beta, dx[contacts.rows]) - moved
    slip -= np.einsum("ek,ek->e", slip, normal)[:, None] * normal
    after, slip_after = by_vertex(contacts.rows, contacts.force, slip)
    pairs = step.pairs
    moved = obstacles.contact_displacements(
        x, step.rows, pairs.beta, pairs.obstacle, pairs.body_points, motions
    )
    slip = pairs.displacement(dx[step.rows]) - pairs.along(moved)
    before, slip_before = by_vertex(step.rows, pairs.force, slip)
    slip = np.maximum(slip_before, slip_after)
    return float(np.vdot(np.abs(after - before), slip)), float(np.maximum(after, before).sum())
