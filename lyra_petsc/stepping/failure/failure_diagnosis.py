"""Diagnosis of a failed solve: its kind, the vertex with the largest residual, and general remedies.

Vertices have their numbers in the mesh. Among equal residuals the smallest number is chosen, so that the
result does not depend on the number of ranks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.mesh.points import Layout, describe_worst
from lyra_petsc.stepping.newton.newton_trace import FailedSolve

SNES = PETSc.SNES.ConvergedReason


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
    """

    number: int
    tag: int
    position: tuple[float, ...]
    before: tuple[float, ...]
    residual: tuple[float, ...]
    forces: dict[str, float]

    @property
    def largest_force(self) -> str:
        """Name of the largest part of the residual."""
        return max(self.forces, key=lambda name: self.forces[name])


@dataclass(frozen=True)
class Diagnosis:
    """Global measures of a failed solve, and its worst vertex.

    Attributes
    ----------
    kind : str
        ``overflow``, ``linear trouble`` or ``nonlinear trouble``.
    norm : float
        Norm of the residual on the free coordinates [N].
    not_finite : int
        Number of vertices whose residual is not finite.
    overflowing : list of str
        Names of the parts of the residual that are not finite.
    vertex : Vertex
    """

    kind: str
    norm: float
    not_finite: int
    overflowing: list[str]
    vertex: Vertex


def diagnose(points: Layout, solve: FailedSolve, x: Array, tags: Array | None) -> Diagnosis:
    """Diagnose a failed solve; collective, the same on every rank.

    Parameters
    ----------
    points : Layout
    solve : FailedSolve
    x : (n_owned, 3) or more rows
        Positions before the step [m].
    tags : (n_owned,) or None
        Node tags in the .msh file.
    """
    comm, solve = points.comm, solve.of_vertices(points.n_vertices)
    forces = {name: np.where(solve.prescribed, 0.0, part) for name, part in solve.forces.items()}
    residual = np.where(solve.prescribed, 0.0, solve.residual)
    norm = _norm(comm, residual)
    not_finite = int(comm.allreduce(int((~np.isfinite(residual).all(axis=1)).sum())))

    def describe(row: int) -> Vertex:
        return Vertex(
            number=int(points.mesh_vertices[row]),
            tag=0 if tags is None else int(tags[row]),
            position=tuple(solve.position[row].tolist()),
            before=tuple(x[row].tolist()),
            residual=tuple(residual[row].tolist()),
            forces={name: float(_norms(part[row])) for name, part in forces.items()},
        )

    return Diagnosis(
        kind="overflow" if not_finite or not math.isfinite(norm) else _trouble(solve),
        norm=norm,
        not_finite=not_finite,
        overflowing=[name for name, part in forces.items() if not math.isfinite(_norm(comm, part))],
        vertex=describe_worst(comm, _norms(residual), points.mesh_vertices, describe),
    )


def _trouble(solve: FailedSolve) -> str:
    """Whether the linear solves or Newton's method failed."""
    if solve.snes_reason == SNES.DIVERGED_LINEAR_SOLVE:
        return "linear trouble"
    # If Newton's method reached its limit of iterations, a last linear solve that failed is the cause only if
    # most of the earlier ones failed, too.
    failed = [iteration.linear_reason < 0 for iteration in solve.iterations[1:]]
    rare = solve.snes_reason == SNES.DIVERGED_MAX_IT and 2 * sum(failed) < len(failed)
    return "nonlinear trouble" if solve.ksp_reason >= 0 or rare else "linear trouble"


def _norm(comm: MPI.Comm, rows: Array) -> float:
    return float(np.sqrt(comm.allreduce(float(np.sum(rows * rows)))))


def _norms(rows: Array) -> Array:
    """Norms of rows, without overflow of their squares; infinite for a row that is not finite."""
    largest = np.abs(rows).max(axis=-1, initial=0.0)
    usable = np.isfinite(largest) & (largest > 0.0)
    scale = np.where(usable, largest, 1.0)[..., None]
    sizes = scale[..., 0] * np.sqrt(np.sum(np.where(np.isfinite(rows), rows / scale, 0.0) ** 2, axis=-1))
    return np.where(np.isfinite(largest), sizes, np.inf)
