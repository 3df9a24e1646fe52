"""Pairs of friction from state to state: made of contacts, continued with their elastic slip, restored."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.contact import friction_pairs
from lyra_petsc.contact.barrier import ContactBarrier
from lyra_petsc.contact.pair_distances import EDGE_EDGE
from lyra_petsc.contact.pairs import Contacts, FrictionPairs, chosen, new_friction_pairs, no_friction_pairs
from lyra_petsc.kernels.sorting import sort_rows


class ContinuedPairs(NamedTuple):
    """Pairs that continue others.

    Attributes
    ----------
    pairs : FrictionPairs
        With ascending keys.
    rows : (E, 4)
        Local rows of their vertices.
    order : (E,)
        Numbers of their contacts.
    previous : (E,)
        Numbers of the pairs that they continue, −1 for none.
    """

    pairs: FrictionPairs
    rows: Ints
    order: Ints
    previous: Ints


def matching(key: Ints, old: FrictionPairs) -> Ints:
    """Number of the pair in ``old`` that each of the keys (E, 10) continues, −1 for none, (E,)."""
    rows = np.empty(len(key), dtype=np.int64)
    friction_pairs.match_pairs(key, old.key, old.slip, old.force, rows)
    return rows


def continued_pairs(
    barrier: ContactBarrier, contacts: Contacts, x: Array, start: Array, old: FrictionPairs
) -> ContinuedPairs:
    """The pairs of ``contacts`` at x, whose slip counts from ``start``, (n_local, 3) each.

    Those that continue pairs in ``old`` keep their elastic slip.
    """
    if not len(contacts.pair):
        none = no_friction_pairs()
        return ContinuedPairs(none, none.vertices, contacts.pair, contacts.pair)
    pair, beta, normal = contacts.pair.copy(), contacts.beta.copy(), contacts.normal.copy()
    near, key = barrier.pairs, np.empty((len(pair), 10), dtype=np.int64)
    identity = near.points, near.vertices, near.kind, near.obstacle
    friction_pairs.choose_triangles(x, barrier.stencil, *identity, beta, normal, pair)
    friction_pairs.write_keys(*identity, beta, pair, key)
    order = sort_rows(np.arange(len(key)), key)
    key, pair, beta, normal = key[order], pair[order], beta[order], normal[order]
    previous = matching(key, old)
    slip = np.concatenate([old.slip, np.zeros((1, 3))])[previous]
    slip -= np.einsum("ek,ek->e", slip, normal)[:, None] * normal
    pairs = new_friction_pairs(key, near.vertices[pair], slip, np.append(old.slides, False)[previous])
    force, stiffness = contacts.force[order], near.stiffness[pair]
    pairs = pairs._replace(beta=beta, force=force, stiffness=stiffness)
    geometry = pairs.tangents, pairs.gradients, pairs.start, pairs.contact_point, pairs.factor
    friction_pairs.measure(start, barrier.stencil, near.points, key, pair, beta, normal, geometry)
    return ContinuedPairs(pairs, barrier.stencil[pair].astype(np.int64), order, previous)


def saved_pairs(pairs: FrictionPairs) -> dict[str, Array]:
    """What a checkpoint holds of pairs besides `FrictionPairs.key`'s vertices, (E, m) each."""
    identity, slides = pairs.key[:, 4:].astype(np.float64), pairs.slides[:, None].astype(np.float64)
    return {"pair": identity, "slip": pairs.slip, "slides": slides}


def restored_pairs(
    vertices: Ints,
    saved: Mapping[str, Array],
    places_before: Mapping[str, tuple[int, int]],
    places: Mapping[str, tuple[int, int]],
) -> FrictionPairs:
    """The pairs of a checkpoint with ``vertices`` (E, 4) and `saved_pairs`.

    Their obstacles had the numbers and first points ``places_before``, and now have ``places`` or are gone.
    The arrays that are not saved are 0.
    """
    identity, kept = saved["pair"].astype(np.int64), np.ones(len(vertices), dtype=np.bool_)
    before = identity.copy()
    for name, (number, first) in places_before.items():
        of_obstacle = before[:, 1] == number
        kept[of_obstacle] = name in places
        identity[of_obstacle, 1], now = places.get(name, (number, first))
        points = before[of_obstacle, 2:]
        identity[of_obstacle, 2:] = np.where(points < 0, points + (first - now), points)
    vertices, identity, slip = vertices[kept], identity[kept], saved["slip"][kept]
    slides, edges, sheets = saved["slides"][kept, 0] > 0.5, identity[:, 0] == EDGE_EDGE, identity[:, 1] < 0
    # the order of vertices in an edge depends on their present numbers
    for rows, first in ((edges, 0), (edges & sheets, 2)):
        reversed_ = rows & (vertices[:, first] > vertices[:, first + 1])
        vertices[reversed_, first : first + 2] = vertices[reversed_, first : first + 2][:, ::-1]
    vertices[edges & ~sheets, 2:] = vertices[edges & ~sheets, :1]
    swapped = edges & sheets & (vertices[:, 0] > vertices[:, 2])
    vertices[swapped], slip[swapped] = vertices[swapped][:, [2, 3, 0, 1]], -slip[swapped]
    key = np.column_stack([vertices, identity])
    return chosen(new_friction_pairs(key, vertices, slip, slides), sort_rows(np.arange(len(key)), key))
