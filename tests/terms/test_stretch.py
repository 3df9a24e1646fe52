"""Principal stretches compared with singular values of deformation gradients."""

from __future__ import annotations

import numpy as np
import pytest

from lyra_petsc.terms.stretch import SOFTENS_BELOW, principal_stretches


def singular_values(x: np.ndarray, stencil: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    corners = x[stencil]
    sides = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)
    return np.linalg.svd(sides @ inverse, compute_uv=False)[:, ::-1]


@pytest.mark.parametrize("seed", [0, 1])
def test_stretches_are_singular_values(seed: int) -> None:
    random = np.random.default_rng(seed)
    x = random.standard_normal((60, 3))
    stencil = np.array([random.choice(60, 3, replace=False) for _ in range(200)], dtype=np.int32)
    inverse = random.standard_normal((200, 2, 2))
    found = principal_stretches(x, stencil, inverse, 150)
    assert found.shape == (150, 2)
    np.testing.assert_allclose(found, singular_values(x, stencil, inverse)[:150], rtol=1e-9, atol=0.0)
    assert np.all(found[:, 0] <= found[:, 1])


def test_a_nearly_collapsed_triangle_keeps_its_digits() -> None:
    x = np.array([[0.0, 0.0, 0.0], [1e3, 0.0, 0.0], [0.0, 0.0, 1e-9]])
    stencil = np.array([[0, 1, 2]], dtype=np.int32)
    np.testing.assert_allclose(principal_stretches(x, stencil, np.eye(2)[None], 1), [[1e-9, 1e3]], rtol=1e-14)


def test_a_triangle_without_any_extent() -> None:
    stencil = np.array([[0, 1, 2]], dtype=np.int32)
    np.testing.assert_array_equal(principal_stretches(np.ones((3, 3)), stencil, np.eye(2)[None], 1), [[0, 0]])


def test_rotations_and_uniform_stretches() -> None:
    angle = 0.7
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    x = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 2.0, 0.0]]) @ turn.T
    stencil = np.array([[0, 1, 2]], dtype=np.int32)
    np.testing.assert_allclose(principal_stretches(x, stencil, np.eye(2)[None], 1), [[0.5, 2.0]])


def test_softening_starts_at_the_maximum_of_the_compressive_stress() -> None:
    stretch = np.linspace(0.5, 0.65, 150_001)
    stress = stretch * (stretch**2 - 1.0)
    assert stretch[np.argmin(stress)] == pytest.approx(SOFTENS_BELOW, abs=1e-6)
