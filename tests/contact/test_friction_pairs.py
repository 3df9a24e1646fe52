"""Friction of pairs: derivatives against differences, the cone, and what sliding leaves."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from lyra_petsc.contact import friction_pairs
from lyra_petsc.contact.pair_distances import EDGE_EDGE, VERTEX_TRIANGLE

Array = NDArray[np.float64]

N = 40


@pytest.fixture
def x() -> Array:
    return np.random.default_rng(0).normal(size=(4 * N, 3))


class Pairs(NamedTuple):
    """Data of friction pairs: stencil, β, n, d, Σ β_i c_i with Σ d_i h_i, and ξ."""

    stencil: NDArray[np.int32]
    beta: Array
    normal: Array
    rotation: Array
    start: Array
    slip: Array

    @property
    def tangents(self) -> Array:
        """(N, 2, 3)."""
        across = np.cross(self.normal, [0.6, 0.0, 0.8])
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        return np.stack([across, np.cross(self.normal, across)], axis=1)

    def state(self, limit: float = 0.4) -> tuple[Array, ...]:
        """The arguments of the kernels."""
        tangents, turns = self.tangents, np.einsum("eck,eik->eci", self.tangents, self.rotation)
        gradients = self.beta[:, None, :, None] * tangents[:, :, None, :]
        gradients = gradients + turns[:, :, :, None] * self.normal[:, None, None, :]
        offset = np.einsum("eck,ek->ec", tangents, self.slip - self.start)
        return self.stencil, gradients, offset, np.full(N, 3.0), np.full(N, limit)


@pytest.fixture
def pairs(x: Array) -> Pairs:
    """Pairs of which about half slide; some are between sheets."""
    random = np.random.default_rng(1)
    stencil = np.arange(4 * N, dtype=np.int32).reshape(N, 4)
    beta = random.normal(size=(N, 4))
    normal = random.normal(size=(N, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    start = np.einsum("ei,eik->ek", beta, x[stencil]) + 0.1 * random.normal(size=(N, 3))
    slip = 0.05 * random.normal(size=(N, 3))
    slip -= np.sum(slip * normal, axis=1, keepdims=True) * normal
    rotation = 0.3 * random.normal(size=(N, 4, 3))
    rotation -= np.einsum("eik,ek->ei", rotation, normal)[:, :, None] * normal[:, None, :]
    rotation[:, 0] = -rotation[:, 1:].sum(axis=1)
    rotation[::2] = 0.0
    heights = np.einsum("eik,ek->ei", x[stencil], normal)
    start += np.einsum("ei,eik->ek", heights, rotation)
    return Pairs(stencil, beta, normal, rotation, start, slip)


@pytest.fixture
def state(pairs: Pairs) -> tuple[Array, ...]:
    return pairs.state()


def energies(x: Array, state: tuple[Array, ...]) -> Array:
    out = np.empty(N)
    friction_pairs.energies(x, *state, out)
    return out


def gradient(x: Array, state: tuple[Array, ...]) -> Array:
    out = np.zeros_like(x)
    friction_pairs.add_gradient(x, *state, out)
    return out


def hessians(x: Array, state: tuple[Array, ...], convexity: float) -> Array:
    values, offsets = np.zeros((10 * N, 3, 3)), 2 * np.arange(10 * N).reshape(N, 10)
    friction_pairs.add_hessians(x, *state, np.ones(N), convexity, offsets, values)
    out = np.empty((N, 4, 4, 3, 3))
    for a, b, block in zip(*np.triu_indices(4), values.reshape(N, 10, 3, 3).swapaxes(0, 1), strict=True):
        out[:, a, b], out[:, b, a] = block, block.swapaxes(1, 2)
    return out


def test_derivatives_are_those_of_the_potential(x: Array, state: tuple[Array, ...]) -> None:
    hessian, h = hessians(x, state, 0.0), 1e-6
    dx = np.random.default_rng(2).normal(size=x.shape)
    slope = (energies(x + h * dx, state) - energies(x - h * dx, state)) / (2 * h)
    np.testing.assert_allclose(
        (gradient(x, state) * dx).reshape(N, 12).sum(axis=1), slope, rtol=1e-5, atol=1e-8
    )
    change = (gradient(x + h * dx, state) - gradient(x - h * dx, state)).reshape(N, 4, 3) / (2 * h)
    expected = np.einsum("nijkm,njm->nik", hessian, dx.reshape(N, 4, 3))
    np.testing.assert_allclose(expected, change, rtol=1e-5, atol=1e-7)
    flat = hessian.transpose(0, 1, 3, 2, 4).reshape(N, 12, 12)
    assert np.linalg.eigvalsh(flat).min() > -1e-12


def test_no_energy_is_above_that_of_regularised_springs(x: Array, state: tuple[Array, ...]) -> None:
    hessian = hessians(x, state, 1.0)
    flat = hessian.transpose(0, 1, 3, 2, 4).reshape(N, 12, 12)
    assert np.linalg.eigvalsh(flat).min() > -1e-12
    here, slope = energies(x, state), gradient(x, state).reshape(N, 12)
    for length in (0.01, 0.1, 1.0, 10.0):
        dx = length * np.random.default_rng(3).normal(size=(N, 12))
        bound = here + (slope * dx).sum(axis=1) + 0.5 * np.einsum("ei,eij,ej->e", dx, flat, dx)
        assert (energies(x + dx.reshape(-1, 3), state) <= bound + 1e-12 * np.abs(bound)).all()


def test_forces_lie_in_the_plane_and_in_the_cone(x: Array, pairs: Pairs) -> None:
    stencil, beta, normal, rotation, _, _ = pairs
    gradients, limit = gradient(x, pairs.state())[stencil], pairs.state()[-1]
    along = np.einsum("eik,ek->ei", gradients, normal)
    forces = (gradients - along[:, :, None] * normal[:, None, :]) / beta[:, :, None]
    np.testing.assert_allclose(forces, np.broadcast_to(forces[:, :1], forces.shape), atol=1e-12)
    np.testing.assert_allclose(along, np.einsum("eik,ek->ei", rotation, forces[:, 0]), atol=1e-12)
    size = np.linalg.norm(forces[:, 0], axis=1)
    assert size.max() <= limit[0] * (1.0 + 1e-12)
    assert 5 < (size > 0.999 * limit[0]).sum() < N - 5


def test_sliding_leaves_what_the_limit_stretches(x: Array, pairs: Pairs) -> None:
    state, tangents, slip = pairs.state(), pairs.tangents, pairs.slip.copy()
    before, force = energies(x, state), gradient(x, state)
    heat, slides = np.empty(N), np.empty(N, dtype=np.bool_)
    friction_pairs.return_map(x, *state, tangents, slip, heat, slides)
    *_, stiffness, limit = state
    size = np.linalg.norm(slip, axis=1)
    assert np.abs(np.einsum("ek,ek->e", slip, pairs.normal)).max() < 1e-15
    np.testing.assert_allclose(size[slides], limit[slides] / stiffness[slides], rtol=1e-12)
    # the work is stored or becomes heat
    np.testing.assert_allclose(0.5 * stiffness * size**2 + heat, before, rtol=1e-12)
    heights = np.einsum("eik,ek->ei", x[pairs.stencil], pairs.normal)
    start = np.einsum("ei,eik->ek", pairs.beta, x[pairs.stencil])
    start += np.einsum("ei,eik->ek", heights, pairs.rotation)
    after = pairs._replace(start=start, slip=slip).state()
    np.testing.assert_allclose(gradient(x, after), force, atol=1e-12)


def pairs_between_sheets(random: np.random.Generator) -> tuple[Array, Pairs]:
    """Points (4 N, 3) and pairs of a vertex and a triangle, or of two edges, some nearest at a corner."""
    points, kind = random.normal(size=(N, 4, 3)), np.where(np.arange(N) < N // 2, VERTEX_TRIANGLE, EDGE_EDGE)
    part = random.uniform(size=(N, 2)) * np.where(np.arange(N) % 3 == 0, 0.0, 1.0)[:, None]
    s, t = part[:, 0], part[:, 1]
    before, crossed = (np.ones(N), s + 0.5 * t - 1.0, -s, -0.5 * t), (1.0 - s, s, t - 1.0, -t)
    beta = np.where((kind == EDGE_EDGE)[:, None], np.stack(crossed, axis=1), np.stack(before, axis=1))
    gap = np.einsum("ei,eik->ek", beta, points)
    normal = gap / np.linalg.norm(gap, axis=1, keepdims=True)
    rotation = np.empty((N, 4, 3))
    for e in range(N):
        friction_pairs.rotation_vectors(points[e], kind[e], normal[e], rotation[e])
    rotation *= np.linalg.norm(gap, axis=1)[:, None, None]
    stencil = np.arange(4 * N, dtype=np.int32).reshape(N, 4)
    start = gap + np.einsum("eik,ek,eim->em", points, normal, rotation)
    slip = random.normal(size=(N, 3))
    slip -= np.sum(slip * normal, axis=1, keepdims=True) * normal
    return points.reshape(-1, 3), Pairs(stencil, beta, normal, rotation, start, slip)


def test_a_common_rotation_of_two_sheets_is_no_slip() -> None:
    """To first order in the angle; and forces have neither a resultant nor a moment."""
    random = np.random.default_rng(4)
    x, pairs = pairs_between_sheets(random)
    state = pairs.state()
    pull = gradient(x, state).reshape(N, 4, 3)
    np.testing.assert_allclose(pull.sum(axis=1), 0.0, atol=1e-13 * np.abs(pull).max())
    moments = np.cross(x.reshape(N, 4, 3), pull).sum(axis=1)
    np.testing.assert_allclose(moments, 0.0, atol=1e-12 * np.abs(pull).max())
    rest = pairs._replace(slip=np.zeros((N, 3)))
    h, axis = 1e-6, np.array([0.6, 0.0, 0.8])
    turned = x + np.cross(h * axis, x) + [0.1, 0.2, 0.3]
    assert np.sqrt(energies(turned, rest.state(np.inf))).max() < 1e-11
    start = np.einsum("ei,eik->ek", pairs.beta, x[pairs.stencil])
    without = rest._replace(rotation=np.zeros((N, 4, 3)), start=start)
    assert np.sqrt(energies(turned, without.state(np.inf))).max() > 1e-7
