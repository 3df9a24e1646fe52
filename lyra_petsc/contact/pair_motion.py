"""Motion of pairs: how far they may move without a collision, and what separates those that come too near.

In all functions x (n_local, 3) [m] are positions of the sheets' vertices and x_obs (m, 3) [m] those of
the obstacles' points; dx and dx_obs are displacements [m]; kind (E,) and points (E, 4) are the pairs.
"""

from __future__ import annotations

import math

import numpy as np

from lyra_petsc.contact.barrier_law import barrier, distance_of_force
from lyra_petsc.contact.pair_distances import (
    EDGE_EDGE,
    VERTEX_PLANE,
    approach_of_pair,
    box_distance,
    distance,
    largest_norm,
    load_points,
    signed_distance,
)
from lyra_petsc.kernels.cache import Index
from lyra_petsc.kernels.element import kernel

CCD_TOLERANCE = 0.1
"""Part of the distance to be covered up to the minimum distance at which continuous collision detection
stops."""

MAX_ADVANCES = 1000
"""Advances of continuous collision detection for one pair, at most: they are short where long displacements
lead past each other."""


@kernel(_nrt=False)
def largest_approach(dx, dx_obs):  # type: ignore[no-untyped-def]
    """Largest distance [m] by which two points, one of them of a sheet, can approach each other."""
    largest = largest_norm(dx, 0, len(dx))
    return largest + max(largest, largest_norm(dx_obs, 0, len(dx_obs)))


@kernel()
def largest_step(x, x_obs, dx, dx_obs, kind, points, offset, far, keep, maximum):  # type: ignore[no-untyped-def]  # fmt: skip
    """Fraction, up to ``maximum``, of displacements dx, dx_obs on which no pair comes too near.

    Each pair keeps at least the part ``keep`` of its distance less the offset, or of ``far`` (E,) [m] if that
    is less. Additive continuous collision detection: Li, Kaufman & Jiang, Codimensional incremental potential
    contact, ACM Trans. Graph. 40 (2021) 170, algorithm 1. It is 0 for a plane that turns by more than 120°.
    """
    approach = largest_approach(dx, dx_obs)
    return _largest_step(x, x_obs, dx, dx_obs, approach, kind, points, offset, far, keep, maximum)


@kernel()
def _largest_step(x, x_obs, dx, dx_obs, approach, kind, points, offset, far, keep, maximum):  # type: ignore[no-untyped-def]  # fmt: skip
    """`largest_step`, where no two points approach each other by more than ``approach`` [m]."""
    p, w = np.empty((4, 3)), np.empty((4, 3))
    for e in range(len(kind)):
        load_points(x, x_obs, points, e, p)
        plane = kind[e] == VERTEX_PLANE
        if not plane and maximum * approach <= (1.0 - keep) * (box_distance(p, kind[e]) - offset[e]):
            continue
        load_points(dx, dx_obs, points, e, w)
        bound = approach_of_pair(kind[e], p, w, maximum)
        d = distance(kind[e], p)
        delta = d - offset[e]
        kept = min(delta, far[e])
        if delta - maximum * bound >= keep * kept or bound == 0.0:
            continue
        if not bound < math.inf:
            return 0.0
        minimum, tolerance, t = keep * kept, (1.0 - keep) * CCD_TOLERANCE * kept, 0.0
        # no advance reaches the minimum distance
        advances = 0
        while delta - minimum > tolerance and advances < MAX_ADVANCES:
            advances += 1
            t += (delta - minimum) / bound
            if t >= maximum:
                break
            load_points(x, x_obs, points, e, p)
            for i in range(4):
                for k in range(3):
                    p[i, k] += t * w[i, k]
            d = distance(kind[e], p)
            delta = d - offset[e]
        maximum = min(maximum, t)
    return maximum


@kernel()
def largest_steps(x, x_obs, dx, dx_obs, kind, points, offset, far, keep, out):  # type: ignore[no-untyped-def]
    """Write the `largest_step` of each of the first len(out) pairs alone to out."""
    approach = largest_approach(dx, dx_obs)
    for e in range(len(out)):
        one = slice(e, e + 1)
        pair = kind[one], points[one], offset[one], far[one]
        out[e] = _largest_step(x, x_obs, dx, dx_obs, approach, *pair, keep, 1.0)


@kernel()
def may_collide(x, x_obs, dx, dx_obs, kind, points, offset, gap, threshold):  # type: ignore[no-untyped-def]
    """Whether any pair may become active on displacements dx, dx_obs.

    Only pairs that approach by more than ``threshold`` [m] count.
    """
    if largest_approach(dx, dx_obs) <= threshold:
        return False
    p, w = np.empty((4, 3)), np.empty((4, 3))
    for e in range(len(kind)):
        load_points(x, x_obs, points, e, p)
        load_points(dx, dx_obs, points, e, w)
        bound = approach_of_pair(kind[e], p, w, 1.0)
        if bound > threshold and distance(kind[e], p) - offset[e] < bound + gap[e]:
            return True
    return False


@kernel()
def target_distances(x, x_obs, dx, kind, points, offset, gap, maximum, expected, target, side, loaded):  # type: ignore[no-untyped-def]  # fmt: skip
    """Distances less offset [m] that pairs shall have after Newton's increment dx (n_local, 3) [m].

    Parameters
    ----------
    expected : (E,)
        Expected force over k [m]; NaN: the force of the linear model for the increment.
    maximum : float
        Largest target over the gap.
    target : (E,)
        Output: the distance at which the barrier has the expected force; −∞ for pairs that stay apart.
    side : (E, 3)
        Output: direction of g for pairs of simplices, to recognise pairs that pass through each other; else
        0.
    loaded : (E,)
        Output: whether the pair has a force in the linear model.
    """
    p, n, beta, no_side = np.empty((4, 3)), np.empty(3), np.empty(4), np.zeros(3)
    approach = 2.0 * largest_norm(dx, 0, len(dx))
    for e in range(len(kind)):
        target[e], loaded[e] = -math.inf, False
        load_points(x, x_obs, points, e, p)
        if box_distance(p, kind[e]) - offset[e] - approach >= gap[e]:
            continue
        d = signed_distance(p, kind[e], no_side, beta, n)
        delta = d - offset[e]
        if not 0.0 < delta < gap[e] + approach:
            continue
        target[e] = maximum * gap[e]
        if kind[e] <= EDGE_EDGE:
            for k in range(3):
                side[e, k] = n[k]
        force = expected[e]
        if math.isnan(force) and delta < gap[e]:
            along = 0.0
            for i in range(4):
                if points[e, i] >= 0:
                    for k in range(3):
                        along += beta[i] * n[k] * dx[Index(points[e, i]), k]
            _, slope, second = barrier(delta, gap[e])
            force = -slope - second * along
        if force > 0.0:
            target[e], loaded[e] = min(target[e], distance_of_force(force, gap[e])), True


@kernel()
def add_corrections(x, x_obs, dx, kind, points, offset, gap, target, side, loaded, tolerance, out, weight):  # type: ignore[no-untyped-def]  # fmt: skip
    """Add displacements that separate pairs which are nearer than their targets after dx; returns their
    number.

    Pairs that are loaded in the linear model but leave the gap, because tangents leave curved surfaces, are
    pulled back. Corrections are added to ``out`` (n_local, 3) [m], each times its weight, and weights to
    ``weight`` (n_local, 1). ``target``, ``side``, ``loaded`` as from `target_distances`; pairs that lack less
    than ``tolerance`` times the gap are left as they are.
    """
    p, n, beta, n_corrected = np.empty((4, 3)), np.empty(3), np.empty(4), 0
    for e in range(len(kind)):
        if not target[e] > -math.inf:
            continue
        load_points(x, x_obs, points, e, p)
        for i in range(4):
            if points[e, i] >= 0:
                for k in range(3):
                    p[i, k] += dx[Index(points[e, i]), k]
        shortfall = target[e] + offset[e] - signed_distance(p, kind[e], side[e], beta, n)
        square = 0.0
        for i in range(4):
            if points[e, i] >= 0:
                square += beta[i] * beta[i]
        leaves = loaded[e] and target[e] - shortfall >= gap[e]
        if not (shortfall > tolerance * gap[e] or leaves) or not square > 0.0:
            continue
        n_corrected += 1
        for i in range(4):
            if points[e, i] >= 0 and beta[i] != 0.0:
                row, row_weight = Index(points[e, i]), abs(beta[i])
                weight[row, 0] += row_weight
                for k in range(3):
                    out[row, k] += row_weight * shortfall * beta[i] / square * n[k]
    return n_corrected
