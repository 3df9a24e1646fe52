"""Notes on scenes in which nothing acts on the sheet, or nothing holds it against static loads."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.select import select_vertices
from lyra_petsc.mesh.topology import connected_components
from lyra_petsc.scene.schema import Keyframe, Scene
from lyra_petsc.scene.time_curve import acts, kink_times
from lyra_petsc.scene.values import AXES
from lyra_petsc.stepping.time_step import Evaluation
from lyra_petsc.terms.registry import Registration, Role, make_term
from lyra_petsc.terms.rest import RestShape
from lyra_petsc.terms.term import Load, UpcomingStep

BALANCED = 1e-9
"""Resultant of loads over the sum of their magnitudes up to which they are in balance."""


def nothing_acts(
    scene: Scene, start: Evaluation, times: Iterable[float], end: float, floor: float
) -> list[str]:
    """A note if the sheet starts at rest and nothing will ever move it, else none; collective.

    Parameters
    ----------
    start : Evaluation
        Of the state at the start.
    times : iterable of float
        Times [s] at which loads begin or end.
    end : float
        End of the run [s].
    floor : float
        Norm [N] of the round-off of internal forces.
    """
    motions = [*scene.motions.values(), *map(scene.keyframes, (scene.obstacles or {}).values())]
    moves = any(frame != Keyframe(time=frame.time) for frames in motions for frame in frames)
    moves = moves or scene.has_frames
    if moves or (scene.wind is not None and acts(scene.wind.velocity)):
        return []
    comm, active, stops = (
        start.forces.layout.comm,
        start.forces.active,
        sorted({0.0, end, *(t for t in times if 0.0 < t < end)}),
    )
    acting = float(np.abs(start.v).max(initial=0.0))
    for t0, t1 in itertools.pairwise(stops):
        for load, at in itertools.product(active.loads, (t0, t1)):
            load.add_force(_during(t0, t1, at, start.x), force := np.zeros_like(start.x))
            acting += float(np.abs(force).max(initial=0.0))
    for term in active.targets:
        upcoming = (_during(at, at, at, start.x) for at in stops)
        places = [term.targets(start.x, term.freeze(step))[0] for step in upcoming]
        acting += sum(float(np.abs(place - places[0]).max(initial=0.0)) for place in places)
    gradient = start.forces.sum(active.elastic, start.x, start.frozen)
    acting, square = comm.allreduce(np.array([acting, float(np.vdot(gradient, gradient))]))
    if acting > 0.0 or square > floor**2:
        return []
    return [
        "nothing acts on the sheet: it starts at rest and free of stress, without gravity, loads, wind or "
        "motions, so it stays as it is"
    ]


def _during(t0: float, t1: float, at: float, x: Array) -> UpcomingStep:
    """A step from t0 to t1 [s] as loads see it at the time ``at`` [s] and positions x (n, 3)."""
    return UpcomingStep(t0, t1, at, x, lambda start, rows: x[rows])


def nothing_holds(
    rest: RestShape, terms: Sequence[Registration], elements: Mapping[str, Elements]
) -> list[str]:
    """A note on each piece of a sheet on which static loads are not in balance, and which no handle holds.

    On rank 0, with all elements of the ``terms``. In contact obstacles may hold a piece, so there are none.
    """
    scene, mesh = rest.scene, rest.mesh
    # moments on edges have no resultant
    on_edges = {name for name, of_term in elements.items() if of_term.edges is not None}
    loads = [entry for entry in terms if entry.role is Role.LOAD and entry.name not in on_edges]
    if not scene.time.static or scene.contact is not None or not loads:
        return []
    # parts that springs or threads hold together are one piece
    elastic = [elements[e.name].stencil for e in terms if e.role is Role.ELASTIC and e.name in elements]
    links = [np.stack([stencil[:, 0], other], axis=1) for stencil in elastic for other in stencil.T[1:]]
    joined = connected_components(mesh.n_vertices, np.concatenate(links))
    piece = np.unique(joined, return_inverse=True)[1].astype(np.int64)
    factors = {1.0, *(factor for factor in kink_times(scene) if 0.0 <= factor <= 1.0)}
    forces: Array = np.zeros((len(factors), mesh.n_vertices, 3))
    for entry in loads:
        term = make_term(entry, elements.get(entry.name), scene, rest.mass)
        assert isinstance(term, Load)
        for force, factor in zip(forces, sorted(factors), strict=True):
            term.add_force(_during(0.0, 1.0, factor, mesh.positions), force)
    force = max(forces, key=lambda force: float(np.linalg.norm(force)))
    held = np.zeros((piece.max() + 1, 3), dtype=bool)
    for number, handle in enumerate(scene.handles):
        vertices = select_vertices(mesh, handle, key=f"handles[{number}]", file=scene.source)
        held[np.ix_(np.unique(piece[vertices]), handle.axis_numbers)] = True
    sums, sizes = (
        np.column_stack([np.bincount(piece, parts) for parts in vectors.T])
        for vectors in (force, np.abs(force))
    )
    free = ~held & (np.abs(sums) > BALANCED * sizes.sum(axis=1, keepdims=True))
    notes = []
    for number in np.flatnonzero(free.any(axis=1)):
        which = "the sheet" if len(held) == 1 else f"the piece of vertex {np.flatnonzero(piece == number)[0]}"
        along = ", ".join(axis for axis, here in zip(AXES, free[number], strict=True) if here)
        resultant = float(np.linalg.norm(sums[number][free[number]]))
        notes.append(
            f"nothing holds {which} along {along} against loads of {resultant:.3g} N: a static analysis "
            "finds no equilibrium; add handles"
        )
    return notes
