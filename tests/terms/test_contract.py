"""What every registered term must fulfil: each derivative against differences of the one before."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from examples import FRAGMENTS, example
from numpy.typing import NDArray
from physics import Simulation, rotation

from lyra_petsc.terms.registry import REGISTRY
from lyra_petsc.terms.term import Elastic, Load, Term, Viscous

Array = NDArray[np.float64]

#: anchored in space: neither invariant under rigid motion nor free of resultants
ANCHORED = {"clamp", "spring"}


def registered(kind: type[Term]) -> list[str]:
    """Names of the registered terms of a kind, whatever the table of examples holds."""
    found = []
    for entry in REGISTRY:
        classes = [c for c in vars(entry.module()).values() if isinstance(c, type) and issubclass(c, kind)]
        found += [c.name for c in classes if getattr(c, "name", None) == entry.name]
    return found


every_term = pytest.mark.parametrize("name", [entry.name for entry in REGISTRY])
every_elastic = pytest.mark.parametrize("name", registered(Elastic))
every_viscous = pytest.mark.parametrize("name", registered(Viscous))
every_load = pytest.mark.parametrize("name", registered(Load))


@pytest.fixture
def simulation(name: str, tmp_path: Path) -> Iterator[Simulation]:
    assert name in FRAGMENTS, f"no example scene for the term '{name}' in examples.py"
    with example(name, tmp_path) as built:
        yield built


@pytest.fixture
def term(simulation: Simulation, name: str) -> Term:
    assert name in simulation.model.terms, f"the example scene does not activate '{name}'"
    return simulation.model.terms[name]


def disturbed(x: Array, size: float, seed: int = 3) -> Array:
    """A shape far from rest, turned in space."""
    rng = np.random.default_rng(seed)
    return np.asarray(
        (x + rng.uniform(-size, size, x.shape)) @ rotation([1.0, 2.0, 0.5], 0.9).T + [0.3, -0.2, 0.1]
    )


def gradient(add: Callable[[Array, Array], None], y: Array) -> Array:
    out = np.zeros_like(y)
    add(y, out)
    return out


def differences(f: Callable[[Array], Array], y: Array, h: float) -> Array:
    """Derivative of f (…) with respect to y (n, 3) by fourth-order central differences, (n, 3, …)."""
    rows = []
    for index in np.ndindex(y.shape):
        e = np.zeros_like(y)
        e[index] = h
        rows.append((8.0 * (f(y + e) - f(y - e)) - (f(y + 2 * e) - f(y - 2 * e))) / (12.0 * h))
    return np.array(rows).reshape(*y.shape, *np.shape(rows[0]))


def dense(term: Term, blocks: Array, n: int) -> Array:
    """Sum of element blocks (E, k, k, 3, 3) as a matrix (n, 3, n, 3)."""
    out = np.zeros((n, 3, n, 3))
    for stencil, block in zip(term.stencil, blocks, strict=True):
        for a, i in enumerate(stencil):
            for b, j in enumerate(stencil):
                out[i, :, j, :] += block[a, b]
    return out


def blocks_of(term: Elastic | Viscous, y: Array, blend: float | None = None) -> Array:
    k = term.stencil.shape[1]
    out = np.full((term.n_elements, k, k, 3, 3), np.nan)
    if isinstance(term, Elastic):
        term.hessians(y, 0, term.n_elements, blend or 0.0, out)
    else:
        term.hessians(y, 0, term.n_elements, out)
    return out


def as_matrices(blocks: Array) -> Array:
    """(E, k, k, 3, 3) as (E, 3k, 3k)."""
    e, k = blocks.shape[:2]
    return blocks.transpose(0, 1, 3, 2, 4).reshape(e, 3 * k, 3 * k)


def test_every_registered_term_has_an_example_and_a_kind() -> None:
    names = {entry.name for entry in REGISTRY}
    assert set(FRAGMENTS) == names
    assert {*registered(Elastic), *registered(Viscous), *registered(Load)} == names


@every_term
def test_is_a_term_of_one_known_kind(term: Term, name: str) -> None:
    assert term.name == name
    assert isinstance(term, (Elastic, Viscous, Load))


# -- energies of the positions -------------------------------------------------------------------------


@pytest.fixture
def elastic(term: Term) -> Elastic:
    assert isinstance(term, Elastic)
    term.prepare(0.0, 0.01, 0.01)
    return term


@every_elastic
@pytest.mark.parametrize("size", [0.01, 0.15])
def test_gradient_is_the_derivative_of_the_energy(
    elastic: Elastic, simulation: Simulation, size: float
) -> None:
    y = disturbed(simulation.system.x, size)
    analytic = gradient(elastic.add_gradient, y)
    numeric = differences(lambda z: elastic.energies(z).sum(), y, 1e-4)
    np.testing.assert_allclose(analytic, numeric, rtol=0.0, atol=1e-8 * np.abs(analytic).max())


@every_elastic
@pytest.mark.parametrize("size", [0.01, 0.15])
def test_exact_hessian_is_the_derivative_of_the_gradient(
    elastic: Elastic, simulation: Simulation, size: float
) -> None:
    y = disturbed(simulation.system.x, size)
    analytic = dense(elastic, blocks_of(elastic, y, 0.0), len(y))
    numeric = differences(lambda z: gradient(elastic.add_gradient, z), y, 1e-4)
    np.testing.assert_allclose(analytic, numeric, rtol=0.0, atol=1e-8 * np.abs(analytic).max())


@every_elastic
@pytest.mark.parametrize("squeeze", [1.0, 0.4])
def test_regularised_hessian_is_positive_semidefinite(
    elastic: Elastic, simulation: Simulation, squeeze: float
) -> None:
    y = disturbed(squeeze * simulation.system.x, 0.1)
    for blend in (0.0, 0.3, 1.0):
        matrices = as_matrices(blocks_of(elastic, y, blend))
        largest = np.abs(matrices).max()
        np.testing.assert_allclose(matrices, matrices.transpose(0, 2, 1), rtol=0.0, atol=1e-13 * largest)
    assert np.linalg.eigvalsh(matrices).min() >= -1e-12 * largest


def test_exact_hessian_of_a_compressed_sheet_is_indefinite(tmp_path: Path) -> None:
    # what the regularisation is there for: without it the test above would say nothing
    with example("membrane", tmp_path) as simulation:
        term = simulation.model.terms["membrane"]
        assert isinstance(term, Elastic)
        matrices = as_matrices(blocks_of(term, 0.4 * simulation.system.x, 0.0))
    assert np.linalg.eigvalsh(matrices).min() < -0.1


@every_elastic
def test_blend_is_the_mixture_of_both(elastic: Elastic, simulation: Simulation) -> None:
    y = disturbed(0.8 * simulation.system.x, 0.1)
    exact, regularised, mixed = (blocks_of(elastic, y, blend) for blend in (0.0, 1.0, 0.3))
    np.testing.assert_allclose(mixed, 0.7 * exact + 0.3 * regularised, atol=1e-12 * np.abs(exact).max())


@every_elastic
def test_hessians_of_a_range_are_those_of_the_whole(elastic: Elastic, simulation: Simulation) -> None:
    y = disturbed(simulation.system.x, 0.1)
    whole = blocks_of(elastic, y, 0.2)
    part = np.empty_like(whole[1:3])
    elastic.hessians(y, 1, 3, 0.2, part)
    np.testing.assert_array_equal(part, whole[1:3])


@every_elastic
def test_no_force_and_no_energy_at_rest(elastic: Elastic, simulation: Simulation) -> None:
    x = simulation.system.x
    stiffness = np.abs(blocks_of(elastic, x, 0.0)).max()
    assert np.abs(gradient(elastic.add_gradient, x)).max() <= 1e-14 * stiffness
    assert np.all(elastic.energies(x) <= 1e-28 * stiffness)


@pytest.mark.parametrize("name", [name for name in registered(Elastic) if name not in ANCHORED])
def test_energy_is_invariant_and_forces_balance(elastic: Elastic, simulation: Simulation) -> None:
    y = disturbed(simulation.system.x, 0.1)
    moved = y @ rotation([0.2, -1.0, 0.7], 2.5).T + [3.0, -1.0, 2.0]
    np.testing.assert_allclose(elastic.energies(moved), elastic.energies(y), rtol=1e-9, atol=1e-16)
    force = gradient(elastic.add_gradient, y)
    np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-13 * np.abs(force).max())
    np.testing.assert_allclose(np.cross(y, force).sum(axis=0), 0.0, atol=1e-13 * np.abs(force).max())


@every_elastic
def test_force_scale_bounds_the_round_off_of_the_force(term: Term, simulation: Simulation) -> None:
    assert isinstance(term, Elastic)
    # 10 ε of this scale is where a step may stop: the force at rest must stay below it
    far = 100.0
    x = simulation.system.x + far
    term.begin(0.0, x)  # springs and clamps set out from where they stand
    before = term.force_scale(far + 1.0)
    term.prepare(0.0, 0.01, 0.01)
    np.testing.assert_array_equal(term.force_scale(far + 1.0), before)
    assert np.all(before > 0.0)
    scale = term.force_scale(far + 1.0)
    assert scale.shape == (term.n_elements,)
    sums = np.bincount(term.stencil.ravel(), np.repeat(scale, term.stencil.shape[1]), len(x))
    noise = np.linalg.norm(gradient(term.add_gradient, x))
    assert noise <= 10.0 * np.finfo(float).eps * np.linalg.norm(sums)


# -- potentials of the velocities ----------------------------------------------------------------------


@pytest.fixture
def viscous(term: Term, simulation: Simulation) -> Viscous:
    assert isinstance(term, Viscous)
    term.freeze(disturbed(simulation.system.x, 0.1), np.zeros_like(simulation.system.x))
    return term


def velocities(n: int) -> Array:
    return np.random.default_rng(5).uniform(-2.0, 2.0, (n, 3))


@every_viscous
def test_viscous_gradient_and_hessian(viscous: Viscous, simulation: Simulation) -> None:
    v = velocities(len(simulation.system.x))
    analytic = gradient(viscous.add_gradient, v)
    numeric = differences(lambda w: viscous.potentials(w).sum(), v, 1e-4)
    np.testing.assert_allclose(analytic, numeric, atol=1e-8 * np.abs(analytic).max())
    hessian = dense(viscous, blocks_of(viscous, v), len(v))
    numeric = differences(lambda w: gradient(viscous.add_gradient, w), v, 1e-4)
    np.testing.assert_allclose(hessian, numeric, atol=1e-8 * np.abs(hessian).max())


@every_viscous
def test_viscous_potential_is_convex(viscous: Viscous, simulation: Simulation) -> None:
    for seed in range(5):
        v = 10.0 * np.random.default_rng(seed).standard_normal(simulation.system.x.shape)
        matrices = as_matrices(blocks_of(viscous, v))
        assert np.linalg.eigvalsh(matrices).min() >= -1e-12 * np.abs(matrices).max()


# -- loads ---------------------------------------------------------------------------------------------


@every_load
def test_potential_of_a_load_is_minus_its_work(term: Term, simulation: Simulation) -> None:
    assert isinstance(term, Load)
    x = simulation.system.x
    force = np.zeros_like(x)
    term.add_force(x, 0.0, 0.01, force)
    assert np.abs(force).max() > 0.0
    moved = disturbed(x, 0.1)
    change = term.potential(moved) - term.potential(x)
    if change != 0.0:
        assert change == pytest.approx(-np.vdot(force, moved - x), rel=1e-12)
