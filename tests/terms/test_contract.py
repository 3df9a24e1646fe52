"""Requirements on every registered term, such as derivatives that agree with finite differences."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from examples import FRAGMENTS, example
from oracle import (
    blocks_of,
    differences,
    directors_along_normals,
    element_hessians,
    frozen_by,
    gradient,
    hessian,
    summed,
)
from physics import Simulation, rotation

from lyra_petsc.arrays import Array
from lyra_petsc.terms.bending.midedge import MidEdge
from lyra_petsc.terms.bending.midedge_shape import Frames
from lyra_petsc.terms.protocols import PullsHandles
from lyra_petsc.terms.registry import REGISTRY, Role
from lyra_petsc.terms.term import Elastic, Load, Term, UpcomingStep, Viscous

pytestmark = pytest.mark.quick


#: terms with targets in space: not invariant under rigid motions, and their forces do not sum to zero
ANCHORED = {"clamp", "clamp_plasticity", "spring"}

#: terms with forces in the start shape (test_chambers.py; test_creases.py)
FILLED = {"chambers", "creases"}

#: all but terms with changing stencils, which have no elements at rest (test_contact_pairs.py and others)
FIXED = [entry for entry in REGISTRY if not entry.of_contact]

#: step of finite differences [m], small where the force of friction has a kink: in shear after 0.1°
STEPS = {"shear_friction": 3e-6}

KINDS = {Role.ELASTIC: Elastic, Role.EXTERNAL: PullsHandles, Role.VISCOUS: Viscous, Role.LOAD: Load}


def names_of(kind: type[Term]) -> list[str]:
    """Names of the registered terms of a kind."""
    return [entry.name for entry in FIXED if issubclass(KINDS[entry.role], kind)]


every_term = pytest.mark.parametrize("name", [entry.name for entry in FIXED])
every_elastic = pytest.mark.parametrize("name", names_of(Elastic))
every_at_rest = pytest.mark.parametrize("name", [n for n in names_of(Elastic) if n not in FILLED])
every_viscous = pytest.mark.parametrize("name", names_of(Viscous))
every_load = pytest.mark.parametrize("name", names_of(Load))


@pytest.fixture
def simulation(name: str, tmp_path: Path) -> Iterator[Simulation]:
    assert name in FRAGMENTS, f"no example scene for the term '{name}' in examples.py"
    with example(name, tmp_path) as built:
        yield built


@pytest.fixture
def term(simulation: Simulation, name: str) -> Term:
    assert name in simulation.problem.terms, f"the example scene does not activate '{name}'"
    return simulation.problem.terms[name]


def moved(simulation: Simulation, x: Array, turn: Array, translation: list[float]) -> Array:
    """The shape x after a rigid motion; unknowns of edges do not change."""
    y, n = x.copy(), simulation.problem.points.n_vertices
    y[:n] = x[:n] @ turn.T + translation
    return y


def disturbed(simulation: Simulation, size: float, squeeze: float = 1.0) -> Array:
    """A randomly disturbed, rotated shape far from rest."""
    n = simulation.problem.points.n_vertices
    x = simulation.equations.x * np.where(np.arange(len(simulation.equations.x)) < n, squeeze, 1.0)[:, None]
    disturbance = np.random.default_rng(3).uniform(-size, size, x.shape)
    y = moved(simulation, x + disturbance, rotation([1.0, 2.0, 0.5], 0.9), [0.3, -0.2, 0.1])
    for term in simulation.problem.terms.values():
        if isinstance(term, MidEdge):  # let directors rotate with the triangles
            indices = term.of_edges.indices
            y.ravel()[indices] = directors_along_normals(term, y) + 0.5 * disturbance.ravel()[indices]
    return y


def turned(frozen: Any, turn: Array) -> Any:
    """The frozen data of a term, rotated with the shape."""
    return Frames(*(vectors @ turn.T for vectors in frozen.vectors)) if isinstance(frozen, Frames) else frozen


def test_every_registered_term_has_an_example_and_a_kind() -> None:
    names = {entry.name for entry in FIXED}
    assert set(FRAGMENTS) == names
    assert {*names_of(Elastic), *names_of(Viscous), *names_of(Load)} == names


@every_term
def test_is_a_term_of_one_known_kind(term: Term, name: str) -> None:
    assert term.name == term.registration.name == name
    assert isinstance(term, KINDS[term.registration.role])
    assert [kind for kind in (Elastic, Viscous, Load) if isinstance(term, kind)] == [
        kind for kind in (Elastic, Viscous, Load) if issubclass(KINDS[term.registration.role], kind)
    ]


# -- energies of the positions -------------------------------------------------------------------------


@pytest.fixture
def elastic(term: Term) -> Elastic:
    assert isinstance(term, Elastic)
    return term


@pytest.fixture
def frozen(term: Term, simulation: Simulation) -> Any:
    """The frozen data of the term, for wind those of a disturbed shape."""
    assert isinstance(term, (Elastic, Viscous))
    x = disturbed(simulation, 0.1) if isinstance(term, Viscous) else simulation.equations.x
    return frozen_by(term, simulation.equations, x)


@every_elastic
@pytest.mark.parametrize("size", [0.01, 0.15])
def test_gradient_is_the_derivative_of_the_energy(
    elastic: Elastic, frozen: Any, simulation: Simulation, size: float
) -> None:
    y = disturbed(simulation, size)
    analytic = gradient(elastic, y, frozen)
    numeric = differences(lambda z: elastic.energies(z, frozen).sum(), y, STEPS.get(elastic.name, 1e-4))
    np.testing.assert_allclose(analytic, numeric, rtol=0.0, atol=1e-8 * np.abs(analytic).max())


@every_elastic
@pytest.mark.parametrize("size", [0.01, 0.15])
def test_exact_hessian_is_the_derivative_of_the_gradient(
    elastic: Elastic, frozen: Any, simulation: Simulation, size: float
) -> None:
    y = disturbed(simulation, size)
    analytic = hessian(elastic, y, frozen, 0.0)
    numeric = differences(lambda z: gradient(elastic, z, frozen), y, STEPS.get(elastic.name, 1e-4))
    np.testing.assert_allclose(analytic, numeric, rtol=0.0, atol=1e-8 * np.abs(analytic).max())


@pytest.mark.parametrize("name", ["membrane", "bending"])
@pytest.mark.parametrize("convexity", [0.3, 1.0])
def test_hessian_is_that_of_a_plain_formula(
    elastic: Elastic, frozen: Any, simulation: Simulation, convexity: float
) -> None:
    y = disturbed(simulation, 0.15)
    found = hessian(elastic, y, frozen, convexity)
    plain = summed(elastic.stencil, blocks_of(elastic, y, frozen, convexity), len(y))
    np.testing.assert_allclose(found, plain, rtol=0.0, atol=1e-12 * np.abs(plain).max())


@every_elastic
@pytest.mark.parametrize("squeeze", [1.0, 0.4])
def test_regularised_hessian_is_positive_semidefinite(
    elastic: Elastic, frozen: Any, simulation: Simulation, squeeze: float
) -> None:
    y = disturbed(simulation, 0.1, squeeze)
    for convexity in (0.0, 0.3, 1.0):
        matrices = element_hessians(elastic, y, frozen, convexity)
        largest = np.abs(matrices).max()
        np.testing.assert_allclose(matrices, matrices.transpose(0, 2, 1), rtol=0.0, atol=1e-13 * largest)
    assert np.linalg.eigvalsh(matrices).min() >= -1e-12 * largest


def test_exact_hessian_of_a_compressed_sheet_is_indefinite(tmp_path: Path) -> None:
    # otherwise the test above would hold without the convexity
    with example("membrane", tmp_path) as simulation:
        term = simulation.problem.membrane
        matrices = element_hessians(term, 0.4 * simulation.equations.x, None, 0.0)
    assert np.linalg.eigvalsh(matrices).min() < -0.1


@every_elastic
def test_regularisation_is_the_mixture_of_both(elastic: Elastic, frozen: Any, simulation: Simulation) -> None:
    y = disturbed(simulation, 0.1, 0.8)
    exact, regularised, mixed = (element_hessians(elastic, y, frozen, part) for part in (0.0, 1.0, 0.3))
    np.testing.assert_allclose(mixed, 0.7 * exact + 0.3 * regularised, atol=1e-12 * np.abs(exact).max())


@every_elastic
def test_weights_multiply_the_hessians_of_elements(
    elastic: Elastic, frozen: Any, simulation: Simulation
) -> None:
    y = disturbed(simulation, 0.1)
    weight = 1.0 + np.arange(elastic.n_elements)
    whole = hessian(elastic, y, frozen, 0.2, weight=weight)
    singly = np.einsum("e,eij->ij", weight, element_hessians(elastic, y, frozen, 0.2)).reshape(whole.shape)
    np.testing.assert_allclose(whole, singly, rtol=0.0, atol=1e-13 * np.abs(singly).max())


@pytest.mark.parametrize("name", sorted(ANCHORED))
def test_hessians_of_a_range_are_those_of_the_whole(
    elastic: Elastic, frozen: Any, simulation: Simulation
) -> None:
    y = disturbed(simulation, 0.1)
    whole = blocks_of(elastic, y, frozen, 0.2)
    part = np.empty_like(whole[1:3])
    elastic.hessians(y, frozen, 1, 3, 0.2, part)
    np.testing.assert_array_equal(part, whole[1:3])


@every_at_rest
def test_no_force_and_no_energy_at_rest(elastic: Elastic, frozen: Any, simulation: Simulation) -> None:
    x = simulation.equations.x
    stiffness = np.abs(element_hessians(elastic, x, frozen, 0.0)).max()
    assert np.abs(gradient(elastic, x, frozen)).max() <= 1e-14 * stiffness
    assert np.all(elastic.energies(x, frozen) <= 1e-28 * stiffness)


@pytest.mark.parametrize("name", [name for name in names_of(Elastic) if name not in ANCHORED])
def test_energy_is_invariant_and_forces_balance(
    elastic: Elastic, frozen: Any, simulation: Simulation
) -> None:
    y = disturbed(simulation, 0.1)
    turn = rotation([0.2, -1.0, 0.7], 2.5)
    other = moved(simulation, y, turn, [3.0, -1.0, 2.0])
    np.testing.assert_allclose(
        elastic.energies(other, turned(frozen, turn)),
        elastic.energies(y, frozen),
        rtol=1e-9,
        atol=1e-16,
    )
    force, y = (rows[: simulation.problem.points.n_vertices] for rows in (gradient(elastic, y, frozen), y))
    np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-13 * np.abs(force).max())
    if elastic.edges is None:  # else moments on edges balance as well, see test_midedge.py
        np.testing.assert_allclose(np.cross(y, force).sum(axis=0), 0.0, atol=1e-13 * np.abs(force).max())


@every_at_rest
def test_force_scale_bounds_the_round_off_of_the_force(term: Term, simulation: Simulation) -> None:
    assert isinstance(term, Elastic)
    # Newton's method may stop at 10 ε of this scale: the force at rest must be below it
    far = 100.0
    x = moved(simulation, simulation.equations.x, np.eye(3), [far, far, far])
    before = term.force_scale(far + 1.0)
    # springs and clamps start at the present positions
    frozen = term.freeze(UpcomingStep(0.0, 0.01, 0.01, x, lambda start, rows: x[rows]))
    np.testing.assert_array_equal(term.force_scale(far + 1.0), before)
    assert np.all(before > 0.0)
    scale = term.force_scale(far + 1.0)
    assert scale.shape == (term.n_elements,)
    sums = np.bincount(term.stencil.ravel(), np.repeat(scale, term.stencil.shape[1]), len(x))
    noise = np.linalg.norm(gradient(term, x, frozen))
    assert noise <= 10.0 * np.finfo(float).eps * np.linalg.norm(sums)


# -- potentials of the velocities ----------------------------------------------------------------------


@pytest.fixture
def viscous(term: Term) -> Viscous:
    assert isinstance(term, Viscous)
    return term


def velocities(n: int) -> Array:
    return np.random.default_rng(5).uniform(-2.0, 2.0, (n, 3))


@every_viscous
def test_viscous_gradient_and_hessian(viscous: Viscous, frozen: Any, simulation: Simulation) -> None:
    v = velocities(len(simulation.equations.x))
    analytic = gradient(viscous, v, frozen)
    numeric = differences(lambda w: viscous.potentials(w, frozen).sum(), v, 1e-4)
    np.testing.assert_allclose(analytic, numeric, atol=1e-8 * np.abs(analytic).max())
    matrix = hessian(viscous, v, frozen)
    numeric = differences(lambda w: gradient(viscous, w, frozen), v, 1e-4)
    np.testing.assert_allclose(matrix, numeric, atol=1e-8 * np.abs(matrix).max())
    plain = summed(viscous.stencil, blocks_of(viscous, v, frozen), len(v))
    np.testing.assert_allclose(matrix, plain, rtol=0.0, atol=1e-13 * np.abs(plain).max())


@every_viscous
def test_viscous_potential_is_convex(viscous: Viscous, frozen: Any, simulation: Simulation) -> None:
    for seed in range(5):
        v = 10.0 * np.random.default_rng(seed).standard_normal(simulation.equations.x.shape)
        matrix = hessian(viscous, v, frozen).reshape(v.size, v.size)
        assert np.linalg.eigvalsh(matrix).min() >= -1e-12 * np.abs(matrix).max()
        # and that of each element
        blocks = blocks_of(viscous, v, frozen)
        k = 3 * blocks.shape[1]
        matrices = blocks.transpose(0, 1, 3, 2, 4).reshape(-1, k, k)
        assert np.linalg.eigvalsh(matrices).min() >= -1e-12 * np.abs(matrices).max()


# -- loads ---------------------------------------------------------------------------------------------


@every_load
def test_potential_of_a_load_is_minus_its_work(term: Term, simulation: Simulation) -> None:
    assert isinstance(term, Load)
    x = simulation.equations.x
    force = np.zeros_like(x)
    term.add_force(UpcomingStep(0.0, 0.01, 0.01, x, simulation.equations.reference.at), force)
    assert np.abs(force).max() > 0.0
    other = disturbed(simulation, 0.1)
    change = term.potential(other) - term.potential(x)
    if change != 0.0:
        assert change == pytest.approx(-np.vdot(force, other - x), rel=1e-12)
