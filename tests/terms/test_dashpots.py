"""Dashpots between nearest points keep momentum and take energy, however many a vertex has."""

from __future__ import annotations

import numpy as np
import pytest

from lyra_petsc.terms.contact import dashpots

VERTICES, PAIRS, DT, DAMPING = 20, 300, 0.01, 0.5


@pytest.mark.parametrize("stiffness", [1e-3, 1.0, 1e3, 1e9])
def test_they_keep_momentum_and_take_energy(stiffness: float) -> None:
    rng = np.random.default_rng(3)
    points = np.array([rng.choice(VERTICES, 4, replace=False) for _ in range(PAIRS)])
    at = rng.dirichlet([1.0, 1.0, 1.0], PAIRS)
    at[:50] = [1.0, 0.0, 0.0]  # corners
    beta = np.column_stack([np.ones(PAIRS), -at])
    normal = rng.normal(size=(PAIRS, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    mass, v = rng.uniform(0.1, 1.0, VERTICES), rng.normal(size=(VERTICES, 3))
    mine, still = np.ones(PAIRS, dtype=bool), np.zeros(PAIRS)
    shared, impulse, push = np.zeros((VERTICES, 3)), np.zeros((VERTICES, 3)), np.empty(PAIRS)
    weight = stiffness * rng.uniform(0.0, 1.0, PAIRS)
    dashpots.share(points, beta, weight, mine, shared)
    inverse = np.repeat(shared[:, :1] / mass[:, None], 3, axis=1)
    given = points, beta, normal, weight, still, mine, DT, DAMPING
    dashpots.damp(v, inverse, *given, push, impulse)
    rate = np.einsum("ei,eik,ek->e", beta, v[points], normal)
    least = weight * np.where(beta != 0.0, 1.0 / inverse[points, 0], np.inf).min(axis=1)
    expected = -least * (1.0 - np.exp(-2.0 * DAMPING * DT * np.sqrt(weight / least))) * rate
    np.testing.assert_allclose(push, expected, rtol=1e-9)
    np.testing.assert_allclose(impulse.sum(axis=0), 0.0, atol=1e-12)
    after = v + impulse / mass[:, None]
    assert np.sum(mass[:, None] * after**2) < np.sum(mass[:, None] * v**2)


def test_a_pair_belongs_to_the_rank_of_one_vertex() -> None:
    points = np.array([[0, 5, 6, 7], [0, 5, 6, 7], [5, 0, -3, -4], [1, 2, 3, 4]])
    beta = np.array([[1, -0.5, -0.5, 0], [0, -0.5, -0.5, 0], [-1, 0.5, 0.5, 0], [0.5, 0.5, -1, 0]])
    vertex, number = np.array([0, -1, 5, -1]), np.array([9, 3, 8, 2, 1, 7, 6, 5])
    mine = np.empty(4, dtype=bool)
    dashpots.find_own(points, beta, vertex, number, 4, mine)
    # of its vertex; of 6, which has the least number; of its vertex; of 3
    np.testing.assert_array_equal(mine, [True, False, False, True])
