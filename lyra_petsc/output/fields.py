"""Fields that a scene may ask for beside the positions; one function and one line each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError
from lyra_petsc.output.tensors import six_components
from lyra_petsc.stepping.problem import Problem

if TYPE_CHECKING:
    from lyra_petsc.terms.bending import Bending

Array = NDArray[np.float64]


def _velocity(problem: Problem) -> Array:
    return problem.system.written_velocity()[: problem.points.n_vertices]


def _displacement(problem: Problem) -> Array:
    assert problem.start is not None  # see `check_field`
    moved: Array = problem.system.x[: problem.points.n_vertices] - problem.start
    return moved


def _green_strain(problem: Problem) -> Array:
    strain, _ = problem.membrane.strain_and_stress(problem.system.x)
    return six_components(strain[: problem.membrane.n_owned])


def _stress(problem: Problem) -> Array:
    _, stress = problem.membrane.strain_and_stress(problem.system.x)
    return six_components(stress[: problem.membrane.n_owned])


def _membrane_energy(problem: Problem) -> Array:
    membrane = problem.membrane
    density: Array = membrane.energies(problem.system.x) / membrane.elements.data["area"][: membrane.n_owned]
    return density


def _to_vertices(problem: Problem, bending: Bending, on_hinges: Array) -> Array:
    """Halves of what hinges carry, summed on their edges' ends and divided by the vertices' rest area."""
    n_local, n_owned = problem.points.n_local, problem.points.n_vertices
    ends = bending.stencil[:, :2].ravel()
    carried = np.bincount(ends, np.repeat(0.5 * on_hinges, 2), n_local)
    membrane = problem.membrane
    thirds = np.repeat(membrane.elements.data["area"] / 3.0, 3)
    area = np.bincount(membrane.stencil.ravel(), thirds, n_local)
    density: Array = carried[:n_owned] / area[:n_owned]
    return density


def _bending_energy(problem: Problem) -> Array:
    bending = _bending(problem)
    return _to_vertices(problem, bending, bending.all_energies(problem.system.x, bending.n_elements))


def _curvature(problem: Problem) -> Array:
    bending, x = _bending(problem), problem.system.x
    # the angle of a collapsed triangle is undefined
    angles = bending.weights(x) * bending.angles(x)
    return _to_vertices(problem, bending, -bending.elements.data["length"] * angles)


def _bending(problem: Problem) -> Bending:
    """The term of the hinges, which `check_field` has seen."""
    from lyra_petsc.terms.bending import Bending

    return next(term for term in problem.terms.values() if isinstance(term, Bending))


def _rank(problem: Problem) -> Array:
    return np.full(problem.points.n_vertices, float(problem.points.comm.rank))


@dataclass(frozen=True)
class Field:
    """Where a field lives, what it is, and how it is computed on one rank (owned rows)."""

    name: str
    on: Literal["vertex", "triangle"]
    meaning: str
    compute: Callable[[Problem], Array]
    term: str = "membrane"


FIELDS = {
    field.name: field
    for field in (
        Field("velocity", "vertex", "m/s, (V, 3)", _velocity),
        Field("displacement", "vertex", "from the positions at t = 0, m, (V, 3)", _displacement),
        Field("green_strain", "triangle", "in material axes, (F, 6): see `tensors`", _green_strain),
        Field("stress", "triangle", "second Piola-Kirchhoff, N/m, likewise, (F, 6)", _stress),
        Field("membrane_energy", "triangle", "J per m² of rest area, (F,)", _membrane_energy),
        Field(
            "bending_energy",
            "vertex",
            "J per m² of rest area, hinges averaged, (V,)",
            _bending_energy,
            "bending",
        ),
        Field("curvature", "vertex", "κ1 + κ2, 1/m, hinge angles averaged, (V,)", _curvature, "bending"),
        Field("rank", "vertex", "owning rank, (V,)", _rank),
    )
}


def chosen(problem: Problem) -> list[Field]:
    """The fields a scene asks for.

    Raises
    ------
    InputError
        For a field of a term that the scene does not have.
    """
    fields = [FIELDS[name] for name in problem.scene.output.fields]
    for field in fields:
        check_field(field, problem)
    return fields


def check_field(field: Field, problem: Problem) -> None:
    """Refuse a field of a term that the scene does not have, or of a start that was not kept.

    Raises
    ------
    InputError
    """
    if field.name == "displacement" and problem.start is None:
        raise InputError(
            "'displacement' needs the start positions, which are kept where output.fields names it",
            file=problem.scene.source,
            key="output.fields",
        )
    if field.term not in problem.terms:
        raise InputError(
            f"'{field.name}' needs the term '{field.term}', which this scene does not have (bending: 0?)",
            file=problem.scene.source,
            key="output.fields",
        )
