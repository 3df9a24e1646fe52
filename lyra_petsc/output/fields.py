"""Fields that a scene can request besides the positions; each is one function and one line in ``FIELDS``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError
from lyra_petsc.output.tensors import six_components
from lyra_petsc.stepping.problem import Problem

if TYPE_CHECKING:
    from lyra_petsc.terms.bending.hinge import Bending
    from lyra_petsc.terms.bending.hinge_plasticity import HingePlasticity
    from lyra_petsc.terms.bending.midedge import MidEdge
    from lyra_petsc.terms.bending.midedge_plasticity import MidEdgePlasticity
    from lyra_petsc.terms.protocols import Located

    OnElements = Callable[[Any, "Array", Located], "Array"]

Ints = NDArray[np.int32]


def _velocity(problem: Problem) -> Array:
    """That of prescribed unknowns is ẋ*(t)."""
    equations = problem.equations
    velocity = equations.v[: len(equations.mass)].copy()
    if equations.step.dt > 0.0:
        equations.step.prescribed.overwrite(velocity, equations.prescriptions.end_rates(equations.step))
    return velocity[: problem.points.n_vertices]


def _displacement(problem: Problem) -> Array:
    """Displacement from the positions at t = 0."""
    assert problem.start is not None  # see `check_field`
    return problem.equations.x[: problem.points.n_vertices] - problem.start


def _green_strain(problem: Problem) -> Array:
    """Green strain in material axes; see `tensors`."""
    strain, _ = problem.membrane.strain_and_stress(problem.equations.x)
    return six_components(strain[: problem.membrane.n_owned])


def _stress(problem: Problem) -> Array:
    """Second Piola-Kirchhoff stress in material axes; see `tensors`."""
    _, stress = problem.membrane.strain_and_stress(problem.equations.x)
    return six_components(stress[: problem.membrane.n_owned])


def _membrane_energy(problem: Problem) -> Array:
    membrane = problem.membrane
    return membrane.energies(problem.equations.x) / membrane.elements.data["area"][: membrane.n_owned]


def _density_on_vertices(problem: Problem, rows: Ints, values: Array) -> Array:
    """Sum of ``values`` (n,) over the local vertices ``rows`` (n,), divided by the vertices' rest area.

    Returns the density of each owned vertex, (n_owned,).
    """
    n_local, n_owned = problem.points.n_local, problem.points.n_vertices
    membrane = problem.membrane
    thirds = np.repeat(membrane.elements.data["area"] / 3.0, 3)
    area = np.bincount(membrane.stencil.ravel(), thirds, n_local)
    return np.bincount(rows, values, n_local)[:n_owned] / area[:n_owned]


def _bending_density(problem: Problem, of_terms: Mapping[str, OnElements]) -> Array:
    """Density on vertices of quantities of bending elements, by the names of their terms, (n_owned,).

    A hinge's value is divided between the two ends of its edge, a triangle's among its three corners.
    """
    here, out = problem.equations.here(), np.zeros(problem.points.n_vertices)
    for name, quantity in of_terms.items():
        if name in problem.terms:
            term: Any = problem.terms[name]
            rows = term.stencil[:, :2] if term.stencil.shape[1] == 4 else term.stencil
            count = rows.shape[1]
            shares = np.repeat(quantity(term, here.x, here.frozen[term]) / count, count)
            out += _density_on_vertices(problem, rows.ravel(), shares)
    return out


def _bending_energy(problem: Problem) -> Array:
    def energies(term: Any, x: Array, frozen: Located) -> Array:
        out: Array = term.all_energies(x, frozen, term.n_elements)
        return out

    names = "bending", "midedge", "hinge_plasticity", "midedge_plasticity", "midedge_friction"
    return _bending_density(problem, dict.fromkeys(names, energies))


def _curvature(problem: Problem) -> Array:
    """Sum of the principal curvatures on vertices [1/m]."""

    def of_hinges(hinges: Bending, x: Array, frozen: Located) -> Array:
        return -hinges.elements.data["length"] * hinges.weights(x) * hinges.angles(x, frozen)

    def of_triangles(midedge: MidEdge, x: Array, frozen: Located) -> Array:
        # NaN curvatures: the angle of a collapsed triangle is undefined
        return midedge.areas * np.nan_to_num(midedge.curvatures(x, frozen)[:, :2].sum(axis=1))

    return _bending_density(problem, {"bending": of_hinges, "midedge": of_triangles})


def _plastic_curvature(problem: Problem) -> Array:
    """Sum of the principal curvatures [1/m], less those of rest, that remain where no moments act."""

    def of_hinges(hinges: HingePlasticity, x: Array, frozen: Located) -> Array:
        return -hinges.elements.data["length"] * hinges.plastic_angles

    def of_triangles(triangles: MidEdgePlasticity, x: Array, frozen: Located) -> Array:
        return triangles.areas * triangles.plastic_curvatures[:, :2].sum(axis=1)

    return _bending_density(problem, {"hinge_plasticity": of_hinges, "midedge_plasticity": of_triangles})


def _curvature_tensor(problem: Problem) -> Array:
    midedge = cast("MidEdge", problem.terms["midedge"])
    here = problem.equations.here()
    curvatures = midedge.curvatures(here.x, here.frozen[midedge])
    out = np.zeros((problem.membrane.n_owned, 3))  # stays zero for triangles without bending stiffness
    numbers = problem.membrane.elements.index[: len(out)]
    order = np.argsort(numbers)
    own = midedge.elements.data["triangle"][: midedge.n_owned]
    out[order[np.searchsorted(numbers, own, sorter=order)]] = curvatures[: midedge.n_owned]
    return six_components(out)


def _contact_pressure(problem: Problem) -> Array:
    """Contact pressure from the sum of the normal forces on both sides; collective."""
    equations = problem.equations
    assert equations.contact is not None
    forces = equations.contact.report(equations.x, equations.step.frozen).normal_forces()
    return _density_on_vertices(problem, np.arange(len(forces), dtype=np.int32), forces)


def _rank(problem: Problem) -> Array:
    return np.full(problem.points.n_vertices, float(problem.points.comm.rank))


@dataclass(frozen=True)
class Field:
    """A field that states can hold.

    Attributes
    ----------
    name : str
    on : str
        ``vertex`` or ``triangle``: what the rows belong to.
    compute : callable
        Returns this rank's rows, (n_owned, ...).
    terms : tuple of str
        The field needs at least one of these terms in the scene.
    """

    name: str
    on: Literal["vertex", "triangle"]
    compute: Callable[[Problem], Array]
    terms: tuple[str, ...] = ("membrane",)


_BENDING = ("bending", "midedge")
_YIELDING = ("hinge_plasticity", "midedge_plasticity")


FIELDS = {
    field.name: field
    for field in (
        Field("velocity", "vertex", _velocity),
        Field("displacement", "vertex", _displacement),
        Field("green_strain", "triangle", _green_strain),
        Field("stress", "triangle", _stress),
        Field("membrane_energy", "triangle", _membrane_energy),
        Field("bending_energy", "vertex", _bending_energy, _BENDING),
        Field("curvature", "vertex", _curvature, _BENDING),
        Field("curvature_tensor", "triangle", _curvature_tensor, ("midedge",)),
        Field("plastic_curvature", "vertex", _plastic_curvature, _YIELDING),
        Field("contact_pressure", "vertex", _contact_pressure, ("contact",)),
        Field("rank", "vertex", _rank),
    )
}
"""Fields by name. Their units are in `scene.schema.FIELD_UNITS`; densities are per rest area."""


def chosen_fields(problem: Problem) -> list[Field]:
    """The fields that the scene requests.

    Raises
    ------
    InputError
        For a field whose term the scene does not have.
    """
    fields = [FIELDS[name] for name in problem.scene.output.fields]
    for field in fields:
        check_field(field, problem)
    return fields


def check_field(field: Field, problem: Problem) -> None:
    """Check that a field can be computed in this scene.

    Raises
    ------
    InputError
        If the scene lacks the field's term, or ``displacement`` lacks the start positions.
    """
    if field.name == "displacement" and problem.start is None:
        raise InputError(
            "'displacement' needs the start positions, which are kept where output.fields names it",
            file=problem.scene.source,
            key="output.fields",
        )
    if not any(term in problem.terms for term in field.terms):
        needed = " or ".join(f"'{term}'" for term in field.terms)
        reasons: dict[tuple[str, ...], str] = {
            ("contact",): "no contact?",
            ("midedge",): "bending_model: hinge?",
            _YIELDING: "no yield_curvature?",
        }
        why = reasons.get(field.terms, "bending: 0?")
        raise InputError(
            f"'{field.name}' needs the term {needed}, which this scene does not have ({why})",
            file=problem.scene.source,
            key="output.fields",
        )
