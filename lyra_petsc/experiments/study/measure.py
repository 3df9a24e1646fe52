"""Errors of a run against a reference, slab by slab: no rank holds a whole state."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from lyra_petsc.experiments.exact.motion import Motion
from lyra_petsc.experiments.study.quantities import MEAN_SQUARE, Quantity
from lyra_petsc.experiments.study.samples import Samples, Surface, read_surface, scatter
from lyra_petsc.experiments.study.transfer import make_transfer
from lyra_petsc.parallel import on_root

Array = NDArray[np.float64]
Errors = dict[str, float]
"""By the name of the quantity; relative, see ``quantities``. NaN where nothing can be told."""

History = dict[str, Array]
"""Errors at each sample after the start, by the name of the quantity."""

Rows = Callable[[int], Array]
"""Positions (n, 3) [m] of this rank's points at a sample."""


@dataclass
class Party:
    """A run to be compared.

    Attributes
    ----------
    samples : Samples
    sheets : sequence of int
        Vertices of each mesh source.
    """

    samples: Samples
    sheets: Sequence[int]


def against_motion(comm: MPI.Comm, run: Party, motion: Motion, quantities: Sequence[Quantity]) -> Errors:
    """Errors of a run against an exact motion; collective."""
    samples = run.samples
    start = samples.rows(comm, 0)
    areas = _areas(comm, on_root(comm, lambda: read_surface(samples.folder), share=False))
    found: History = {}
    if any(quantity.name.startswith("position") for quantity in quantities):
        found |= _positions(
            comm,
            samples,
            lambda i: samples.rows(comm, i),
            lambda i: motion.positions(start, samples.times[i]),
            areas,
            samples.size,
        )
    forms = [motion.energies(t) for t in samples.times]
    exact = np.array([[form.kinetic, form.membrane, 0.0, form.potential] for form in forms])
    found["energy"] = _energy(samples.energies, exact, float(np.abs(exact - exact[0]).max()))
    for quantity in quantities:
        if quantity.probe is not None and quantity.probe in samples.probes:
            path = samples.probes[quantity.probe]
            expected = [motion.positions(path[:1], t)[0] for t in samples.times]
            found[quantity.name] = _path(path, np.array(expected), samples.size)
    return overall(_of(quantities, found))


def against_run(comm: MPI.Comm, run: Party, reference: Party, quantities: Sequence[Quantity]) -> Errors:
    """Errors of a run against another, over all samples; collective."""
    return overall(history_against_run(comm, run, reference, quantities))


def history_against_run(
    comm: MPI.Comm, run: Party, reference: Party, quantities: Sequence[Quantity]
) -> History:
    """Errors of a run against another at each sample; collective.

    On different meshes the finer solution is interpolated at the rest places of the coarser one's
    vertices.
    """
    mine, other = run.samples, reference.samples
    found: History = {}
    if any(quantity.name.startswith("position") for quantity in quantities):
        found |= _between(comm, run, reference)
    found["energy"] = _energy(mine.energies, other.energies, other.exchanged)
    for quantity in quantities:
        name = quantity.probe
        if name is not None and name in mine.probes and name in other.probes:
            found[quantity.name] = _path(mine.probes[name], other.probes[name], other.size)
    return _of(quantities, found)


def overall(history: History) -> Errors:
    """The error over all samples: the root mean square of the L2 norms, of all others the largest."""
    return {name: _overall(name, values) for name, values in history.items()}


def _overall(name: str, values: Array) -> float:
    if len(values) == 0:
        return math.nan
    return math.sqrt(float(np.mean(values**2))) if name == MEAN_SQUARE else float(values.max())


def _of(quantities: Sequence[Quantity], found: History) -> History:
    """The quantities in their order; empty where nothing can be told."""
    return {quantity.name: found.get(quantity.name, np.empty(0)) for quantity in quantities}


def _between(comm: MPI.Comm, run: Party, reference: Party) -> History:
    coarse, fine = run, reference
    if run.samples.n_vertices > reference.samples.n_vertices:
        coarse, fine = reference, run
    both = [party.samples.folder for party in (coarse, fine)]
    found = on_root(comm, lambda: [read_surface(folder) for folder in both], share=False)
    at, beyond = found or (None, None)
    same = comm.bcast(at is not None and beyond is not None and at.same_as(beyond), root=0)
    here: Rows = lambda i: coarse.samples.rows(comm, i)  # noqa: E731
    there: Rows = lambda i: fine.samples.rows(comm, i)  # noqa: E731
    if not same:
        transfer = make_transfer(comm, at, coarse.sheets, beyond, fine.sheets)
        there = lambda i: transfer.rows(comm, fine.samples, i)  # noqa: E731
    return _positions(comm, coarse.samples, here, there, _areas(comm, at), reference.samples.size)


def _areas(comm: MPI.Comm, surface: Surface | None) -> Array:
    """This rank's slab of the vertices' rest areas [m²]; ``surface`` on rank 0."""
    return scatter(comm, None if surface is None else surface.areas)


def _positions(
    comm: MPI.Comm, samples: Samples, here: Rows, there: Rows, areas: Array, size: float
) -> History:
    """Largest and area-weighted L2 error over space, at each sample after the start."""
    whole = comm.allreduce(float(areas.sum()))
    count = len(samples.times) - 1
    largest, squares = np.empty(count), np.empty(count)
    for i in range(count):
        distance = np.linalg.norm(here(i + 1) - there(i + 1), axis=1)
        largest[i] = comm.allreduce(float(distance.max(initial=0.0)), MPI.MAX)
        squares[i] = comm.allreduce(float(areas @ distance**2)) / whole
    return {"position_max": largest / size, MEAN_SQUARE: np.sqrt(squares) / size}


def _energy(mine: Array, other: Array, exchanged: float) -> Array:
    """Error of the total energy over the largest energy exchanged."""
    if not exchanged > 0.0:
        return np.empty(0)
    return np.asarray(np.abs(mine.sum(axis=1) - other.sum(axis=1)) / exchanged)


def _path(mine: Array, other: Array, size: float) -> Array:
    return np.asarray(np.linalg.norm(mine - other, axis=1) / size)
