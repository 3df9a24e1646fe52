"""Diagnosis of a failed solve: norms, the vertex and triangle with the largest residual, and their state.

All functions are collective and return the same on every rank. Vertices and triangles have their numbers in
the mesh. Among equal residuals the smallest number is chosen, so that the result does not depend on the
number of ranks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from mpi4py import MPI

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.mesh.points import Layout
from lyra_petsc.stepping.newton.newton_trace import FailedSolve
from lyra_petsc.terms.handles.prescribed_handles import ExactHandles
from lyra_petsc.terms.membrane import Membrane

Result = TypeVar("Result")

TIE = 1e-6
"""Relative difference up to which two residuals count as equally large."""


@dataclass(frozen=True)
class Vertex:
    """The vertex with the largest residual.

    Attributes
    ----------
    number : int
    tag : int
        Node tag in the .msh file, if it differs from the number; else 0.
    position, before : tuple of 3 floats
        At the failing iterate and before the step [m].
    residual : tuple of 3 floats
        [N].
    forces : dict of name → float
        Norms [N] of the parts of the residual.
    moved : float
        Distance from the position before the step [m].
    mass : float
        [kg].
    """

    number: int
    tag: int
    position: tuple[float, ...]
    before: tuple[float, ...]
    residual: tuple[float, ...]
    forces: dict[str, float]
    moved: float
    mass: float


@dataclass(frozen=True)
class Triangle:
    """The triangle with the largest residual at its vertices (root of the sum of squares).

    Attributes
    ----------
    number : int
    vertices : tuple of 3 ints
    centre : tuple of 3 floats
        At the failing iterate [m].
    residual : float
        [N].
    aspect : float
        Longest side over shortest height, at rest; 1.15 if equilateral.
    stretches : tuple of 2 floats
        Principal stretches at the failing iterate, the smaller first.
    """

    number: int
    vertices: tuple[int, ...]
    centre: tuple[float, ...]
    residual: float
    aspect: float
    stretches: tuple[float, ...]


@dataclass(frozen=True)
class Diagnosis:
    """Global measures of a failed solve, and its worst vertex and triangle.

    Attributes
    ----------
    norm : float
        Norm of the residual on the free coordinates [N].
    scale : float
        Largest norm of its finite parts [N].
    not_finite : int
        Number of vertices whose residual is not finite.
    iterate_finite : bool
        Whether the velocities are finite.
    overflowing : list of str
        Names of the parts of the residual that are not finite.
    vertex : Vertex
    triangle : Triangle
    handle : int or None
        The handle with the largest prescribed displacement in the step; None if no handle moves.
    jump : float
        This displacement [m].
    """

    norm: float
    scale: float
    not_finite: int
    iterate_finite: bool
    overflowing: list[str]
    vertex: Vertex
    triangle: Triangle
    handle: int | None
    jump: float


def diagnose(
    points: Layout,
    membrane: Membrane,
    held: ExactHandles,
    solve: FailedSolve,
    x: Array,
    mass: Array,
    tags: Array | None,
) -> Diagnosis:
    """Diagnose a failed solve.

    Parameters
    ----------
    points : Layout
    membrane : Membrane
    held : ExactHandles
    solve : FailedSolve
    x : (n_owned, 3) or more rows
        Positions before the step [m].
    mass : (n_owned,) [kg]
    tags : (n_owned,) or None
        Node tags in the .msh file.
    """
    comm, n = points.comm, points.n_vertices
    solve = solve.of_vertices(n)
    free = ~solve.prescribed
    residual = np.where(free, solve.residual, 0.0)
    wrong = ~np.isfinite(residual).all(axis=1)
    forces = {name: np.where(free, part, 0.0) for name, part in solve.forces.items()}
    squares = {name: _squared_norm(comm, part) for name, part in forces.items()}
    finite = [square for square in squares.values() if np.isfinite(square)]
    handle, jump = _largest_handle_motion(comm, held, solve, x[:n])
    return Diagnosis(
        norm=float(np.sqrt(_squared_norm(comm, residual))),
        scale=float(np.sqrt(max(finite, default=0.0))),
        not_finite=int(comm.allreduce(int(wrong.sum()))),
        iterate_finite=not comm.allreduce(int(not np.isfinite(solve.velocity).all())),
        overflowing=[name for name, square in squares.items() if not np.isfinite(square)],
        vertex=_vertex(points, solve, residual, forces, x[:n], mass, tags),
        triangle=_triangle(points, membrane, solve, residual),
        handle=handle,
        jump=jump,
    )


def _squared_norm(comm: MPI.Comm, rows: Array) -> float:
    return float(comm.allreduce(float(np.sum(rows * rows))))


def _norms(rows: Array) -> Array:
    """Norms of rows, without overflow of their squares; infinite for a row that is not finite."""
    largest = np.abs(rows).max(axis=-1, initial=0.0)
    usable = np.isfinite(largest) & (largest > 0.0)
    scale = np.where(usable, largest, 1.0)[..., None]
    sizes = scale[..., 0] * np.sqrt(np.sum(np.where(np.isfinite(rows), rows / scale, 0.0) ** 2, axis=-1))
    return np.where(np.isfinite(largest), sizes, np.inf)


def describe_worst(comm: MPI.Comm, sizes: Array, numbers: Ints, describe: Callable[[int], Result]) -> Result:
    """Describe the row with the largest size, among equals that with the smallest number; collective.

    Parameters
    ----------
    comm : MPI.Comm
    sizes : (n,)
        Sizes of this rank's rows; not NaN, may be infinite. At least one rank has a row.
    numbers : (n,) int64
        Numbers of the rows, unique over all ranks.
    describe : callable
        Returns the description of a row; called on the rank that has the row, and broadcast.
    """
    largest = comm.allreduce(float(sizes.max(initial=-np.inf)), MPI.MAX)
    bad = np.flatnonzero(sizes >= largest * (1.0 - TIE)) if len(sizes) else np.empty(0, np.int64)
    none = np.iinfo(np.int64).max
    first = int(numbers[bad].min()) if len(bad) else none
    number, rank = comm.allreduce((first, comm.rank), MPI.MIN)
    mine = describe(int(bad[np.argmin(numbers[bad])])) if rank == comm.rank and number != none else None
    result: Result | None = comm.bcast(mine, root=rank)
    assert result is not None
    return result


def _vertex(
    points: Layout,
    solve: FailedSolve,
    residual: Array,
    forces: dict[str, Array],
    x: Array,
    mass: Array,
    tags: Array | None,
) -> Vertex:
    def describe(row: int) -> Vertex:
        return Vertex(
            number=int(points.mesh_vertices[row]),
            tag=0 if tags is None else int(tags[row]),
            position=_floats(solve.position[row]),
            before=_floats(x[row]),
            residual=_floats(residual[row]),
            forces={name: float(_norms(part[row])) for name, part in forces.items()},
            moved=float(_norms(solve.position[row] - x[row])),
            mass=float(mass[row]),
        )

    return describe_worst(points.comm, _norms(residual), points.mesh_vertices, describe)


def _triangle(points: Layout, membrane: Membrane, solve: FailedSolve, residual: Array) -> Triangle:
    n, owned = points.n_vertices, membrane.n_owned
    # triangles need residual norms and mesh numbers, in two columns, and positions of ghosts, too
    norm_and_number, position = np.zeros((points.n_local, 3)), np.zeros((points.n_local, 3))
    norm_and_number[:n, 0], norm_and_number[:n, 1] = _norms(residual), points.mesh_vertices
    position[:n] = solve.position
    points.update_ghosts(norm_and_number)
    points.update_ghosts(position)
    stencil = membrane.stencil[:owned]
    sizes = _norms(norm_and_number[stencil, 0])
    inverse = membrane.elements.data["inverse"]

    def describe(row: int) -> Triangle:
        corners = position[stencil[row]]
        return Triangle(
            number=int(membrane.elements.index[row]),
            vertices=tuple(int(number) for number in norm_and_number[stencil[row], 1]),
            centre=_floats(corners.mean(axis=0)),
            residual=float(sizes[row]),
            aspect=_aspect(inverse[row]),
            stretches=_stretches(corners, inverse[row]),
        )

    return describe_worst(points.comm, sizes, membrane.elements.index[:owned].astype(np.int64), describe)


def _aspect(inverse: Array) -> float:
    """Longest side over shortest height of the triangle with this inverse rest matrix (2, 2)."""
    first, second = np.linalg.inv(inverse).T
    longest = max(float(side @ side) for side in (first, second, second - first))
    return longest * abs(float(np.linalg.det(inverse)))


def _stretches(corners: Array, inverse: Array) -> tuple[float, ...]:
    gradient = np.column_stack([corners[1] - corners[0], corners[2] - corners[0]]) @ inverse
    if not np.isfinite(gradient).all():
        return (float("nan"), float("nan"))
    return _floats(np.linalg.svd(gradient, compute_uv=False)[::-1])


def _largest_handle_motion(
    comm: MPI.Comm, held: ExactHandles, solve: FailedSolve, x: Array
) -> tuple[int | None, float]:
    """The handle with the largest prescribed displacement of a vertex, and this displacement [m]."""
    distances = _norms(np.where(solve.prescribed, solve.goal - x, 0.0))
    numbers = held.numbers
    if not numbers:
        return None, 0.0
    local = np.array([distances[held.vertices(number)].max(initial=0.0) for number in numbers])
    largest = np.empty_like(local)
    comm.Allreduce(local, largest, MPI.MAX)
    first = int(np.argmax(largest))
    return (numbers[first], float(largest[first])) if largest[first] > 0.0 else (None, 0.0)


def _floats(row: Array) -> tuple[float, ...]:
    return tuple(float(value) for value in row)
