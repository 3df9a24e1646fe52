"""Friction of pairs: derivatives against differences, the cone, and what sliding leaves."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lyra_petsc.terms import friction_pairs
from lyra_petsc.terms.contact_pairs import VERTEX_TRIANGLE

Array = NDArray[np.float64]

N = 40


@pytest.fixture
def x() -> Array:
    return np.random.default_rng(0).normal(size=(4 * N, 3))


@pytest.fixture
def state(x: Array) -> tuple[Array, ...]:
    """Pairs of which about half slide."""
    random = np.random.default_rng(1)
    stencil = np.arange(4 * N, dtype=np.int32).reshape(N, 4)
    beta = random.normal(size=(N, 4))
    normal = random.normal(size=(N, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    start = np.einsum("ei,eik->ek", beta, x[stencil]) + 0.1 * random.normal(size=(N, 3))
    slip = 0.05 * random.normal(size=(N, 3))
    slip -= np.sum(slip * normal, axis=1, keepdims=True) * normal
    return stencil, beta, normal, start, slip, np.full(N, 3.0), np.full(N, 0.4)


def energies(x: Array, state: tuple[Array, ...]) -> Array:
    out = np.empty(N)
    friction_pairs.energies(x, *state, out)
    return out


def gradient(x: Array, state: tuple[Array, ...]) -> Array:
    out = np.zeros_like(x)
    friction_pairs.add_gradient(x, *state, out)
    return out


def hessians(x: Array, state: tuple[Array, ...], blend: float) -> Array:
    values, offsets = np.zeros((10 * N, 3, 3)), 2 * np.arange(10 * N).reshape(N, 10)
    friction_pairs.add_hessians(x, *state, np.ones(N), blend, offsets, values)
    out = np.empty((N, 4, 4, 3, 3))
    for a, b, block in zip(*np.triu_indices(4), values.reshape(N, 10, 3, 3).swapaxes(0, 1), strict=True):
        out[:, a, b], out[:, b, a] = block, block.swapaxes(1, 2)
    return out


def test_derivatives_are_those_of_the_potential(x: Array, state: tuple[Array, ...]) -> None:
    hessian, h = hessians(x, state, 0.0), 1e-6
    way = np.random.default_rng(2).normal(size=x.shape)
    slope = (energies(x + h * way, state) - energies(x - h * way, state)) / (2 * h)
    np.testing.assert_allclose(
        (gradient(x, state) * way).reshape(N, 12).sum(axis=1), slope, rtol=1e-5, atol=1e-8
    )
    change = (gradient(x + h * way, state) - gradient(x - h * way, state)).reshape(N, 4, 3) / (2 * h)
    expected = np.einsum("nijkm,njm->nik", hessian, way.reshape(N, 4, 3))
    np.testing.assert_allclose(expected, change, rtol=1e-5, atol=1e-7)
    flat = hessian.transpose(0, 1, 3, 2, 4).reshape(N, 12, 12)
    assert np.linalg.eigvalsh(flat).min() > -1e-12


def test_no_energy_is_above_that_of_regularised_springs(x: Array, state: tuple[Array, ...]) -> None:
    hessian = hessians(x, state, 1.0)
    flat = hessian.transpose(0, 1, 3, 2, 4).reshape(N, 12, 12)
    assert np.linalg.eigvalsh(flat).min() > -1e-12
    here, slope = energies(x, state), gradient(x, state).reshape(N, 12)
    for length in (0.01, 0.1, 1.0, 10.0):
        way = length * np.random.default_rng(3).normal(size=(N, 12))
        bound = here + (slope * way).sum(axis=1) + 0.5 * np.einsum("ei,eij,ej->e", way, flat, way)
        assert (energies(x + way.reshape(-1, 3), state) <= bound + 1e-12 * np.abs(bound)).all()


def test_forces_lie_in_the_plane_and_in_the_cone(x: Array, state: tuple[Array, ...]) -> None:
    stencil, beta, normal, _, _, _, limit = state
    forces = gradient(x, state)[stencil] / beta[:, :, None]
    np.testing.assert_allclose(forces, np.broadcast_to(forces[:, :1], forces.shape), atol=1e-12)
    size = np.linalg.norm(forces[:, 0], axis=1)
    assert np.abs(np.sum(forces[:, 0] * normal, axis=1)).max() < 1e-12
    assert size.max() <= limit[0] * (1.0 + 1e-12)
    assert 5 < (size > 0.999 * limit[0]).sum() < N - 5


def test_sliding_leaves_what_the_limit_stretches(x: Array, state: tuple[Array, ...]) -> None:
    before, force = energies(x, state), gradient(x, state)
    heat, slides = np.empty(N), np.empty(N, dtype=np.bool_)
    friction_pairs.slide(x, *state, heat, slides)
    *_, slip, stiffness, limit = state
    size = np.linalg.norm(slip, axis=1)
    np.testing.assert_allclose(size[slides], limit[slides] / stiffness[slides], rtol=1e-12)
    # what was put in is stored or heat
    np.testing.assert_allclose(0.5 * stiffness * size**2 + heat, before, rtol=1e-12)
    start = np.einsum("ei,eik->ek", state[1], x[state[0]])
    after = (*state[:3], start, *state[4:])
    np.testing.assert_allclose(gradient(x, after), force, atol=1e-12)


def test_rounding_does_not_tell_which_of_two_sliding_pairs_goes_on() -> None:
    """A vertex that comes over an edge goes on with the triangle that held it by more force."""
    triangles, edge = [[7, 1, 2, 3], [7, 2, 1, 4]], [[7, 1, 2, 2]]
    keys = np.zeros((3, 10), dtype=np.int64)
    keys[:, :4], keys[:, 4], keys[:, 5] = [*triangles, *edge], VERTEX_TRIANGLE, -1
    among, key = keys[:2], keys[2:]
    what = np.zeros((2, friction_pairs.COLUMNS))
    what[:, friction_pairs.SLIP], what[:, friction_pairs.FORCE] = 1e-5, (1.0, 2.0)
    for order in ([0, 1], [1, 0]):
        for longer in (0, 1):
            old = what.copy()
            old[longer, friction_pairs.SLIP] *= 1.0 + 1e-12
            place = np.empty(1, dtype=np.int64)
            friction_pairs.find(key, among[order], old[order], place)
            assert order[place[0]] == 1
    what[0, friction_pairs.SLIP] *= 1.01  # one that sticks still
    friction_pairs.find(key, among, what, place)
    assert place[0] == 0
