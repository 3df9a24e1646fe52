"""Triangles found from hinges: sums over triangles equal sums over hinges."""

from __future__ import annotations

import numpy as np
import pytest
from oracle import bending_blocks, expanded, gradient, summed

from lyra_petsc.arrays import Array, Ints
from lyra_petsc.linear.pattern import BlockPattern
from lyra_petsc.mesh.elements import Elements
from lyra_petsc.mesh.topology import hinges
from lyra_petsc.terms.bending.hinge import Bending
from lyra_petsc.terms.registry import registration_of
from lyra_petsc.terms.term import Assembly


def strip(n: int, *, twisted: bool) -> Ints:
    """A closed band of 2 n triangles with n + n vertices; with ``twisted`` a Möbius band."""
    low, high = np.arange(n), n + np.arange(n)
    low_next, high_next = np.roll(low, -1), np.roll(high, -1)
    if twisted:
        low_next[-1], high_next[-1] = high_next[-1], low_next[-1]
    first = np.column_stack([low, low_next, high_next])
    second = np.column_stack([low, high_next, high])
    return np.concatenate([first, second])


def octahedron() -> Ints:
    """A closed surface with every vertex in four triangles."""
    upper = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 1)]
    return np.array(upper + [(5, c, b) for _, b, c in upper])


def turned(triangles: Ints) -> Ints:
    """The triangles, every third with the opposite orientation."""
    out = triangles.copy()
    out[::3] = out[::3, ::-1]
    return out


def hinges_of(triangles: Ints) -> tuple[Ints, Ints]:
    """Hinges (E, 4) and the corners (E, 2) of their opposite vertices."""
    vertices, faces = hinges(triangles)
    opposite = [np.argmax(triangles[faces[:, i]] == vertices[:, 2 + i, None], axis=1) for i in (0, 1)]
    return vertices, np.stack(opposite, axis=1)


def given(rows: list[list[int]], opposite: list[list[int]]) -> tuple[Ints, Ints]:
    return np.array(rows, dtype=np.int64).reshape(-1, 4), np.array(opposite, dtype=np.int64).reshape(-1, 2)


SHEETS = {
    "octahedron": hinges_of(octahedron()),
    "band": hinges_of(strip(7, twisted=False)),
    "Möbius band": hinges_of(strip(7, twisted=True)),
    "turned triangles": hinges_of(turned(strip(7, twisted=False))),
    "one hinge": given([[3, 1, 0, 2]], [[2, 0]]),
    "the same hinge twice": given([[3, 1, 0, 2], [3, 1, 0, 2], [1, 3, 2, 0]], [[2, 1], [2, 1], [1, 2]]),
    "three triangles on an edge": given([[0, 1, 2, 3], [0, 1, 2, 4], [1, 0, 3, 4]], [[2, 2], [2, 0], [2, 0]]),
    "none": given([], []),
}
every_sheet = pytest.mark.parametrize("name", SHEETS)


def shape(n: int) -> Array:
    return np.random.default_rng(n).uniform(-1.0, 1.0, (n, 3))


def bending(name: str, limit: float = 0.0) -> Bending:
    stencil, opposite = SHEETS[name]
    n = len(stencil)
    rng = np.random.default_rng(3)
    data = {
        "k": rng.uniform(0.5, 2.0, n),
        "rest_angle": rng.uniform(-0.5, 0.5, n),
        "limit": np.full((n, 2), limit),
        "rest_height": np.ones(n),
        "opposite_corners": opposite.astype(np.float64),
        "damping": np.zeros(n),
    }
    return made(Elements(stencil.astype(np.int32), data))


def made(elements: Elements) -> Bending:
    term = Bending(elements)
    term.registration = registration_of("bending")
    return term


def alone(name: str, limit: float = 0.0) -> list[Bending]:
    """One term for each hinge of ``bending``."""
    (stencil, opposite), data = SHEETS[name], bending(name, limit).elements.data
    found = []
    for row, points in enumerate(stencil):
        own = {key: values[row : row + 1] for key, values in data.items()}
        own |= {
            "limit": np.full((1, 2), limit),
            "opposite_corners": opposite[row : row + 1].astype(np.float64),
        }
        found.append(made(Elements(points[None].astype(np.int32), own)))
    return found


@every_sheet
@pytest.mark.parametrize("limit", [0.0, 0.3])  # none fades, some do
def test_sums_over_triangles_are_sums_over_hinges(name: str, limit: float) -> None:
    term, x = bending(name, limit), shape(14)
    singly = alone(name, limit)
    np.testing.assert_allclose(
        term.energies(x), [one.energies(x)[0] for one in singly], rtol=1e-12, atol=1e-15
    )
    found, expected = gradient(term, x, None), np.zeros_like(x)
    for one in singly:
        one.add_gradient(x, None, expected)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-12 * np.abs(expected).max(initial=1.0))


@every_sheet
@pytest.mark.parametrize("limit", [0.0, 0.3])
@pytest.mark.parametrize(("convexity", "n_owned"), [(0.0, 14), (0.4, 5)])
def test_block_rows_are_those_of_the_element_hessians(
    name: str, limit: float, convexity: float, n_owned: int
) -> None:
    term, x = bending(name, limit), shape(14)
    pattern = BlockPattern(term.couplings, n_owned, 14)
    values = np.zeros((pattern.n_blocks, 3, 3))
    weight = 1.0 + np.arange(term.n_elements)
    term.add_hessian(x, None, Assembly(weight, pattern.offsets, values, convexity))
    blocks = weight[:, None, None, None, None] * bending_blocks(term, x, convexity)
    expected = summed(term.stencil, blocks, 14)[:n_owned]
    assert expected.any() == bool(term.n_elements)
    np.testing.assert_allclose(
        expanded(pattern, values, 14),
        expected,
        rtol=0.0,
        atol=1e-12 * np.abs(expected).max(initial=1.0),
    )
    # and the pattern is that of the whole stencil
    whole = BlockPattern({"hinges": term.stencil}, n_owned, 14)
    assert whole.columns.tolist() == pattern.columns.tolist()
    assert whole.indptr.tolist() == pattern.indptr.tolist()


def test_coincident_points_give_finite_results() -> None:
    """Two points at one position: an edge without length, triangles without area."""
    stencil, _ = SHEETS["band"]
    term, x = bending("band", 1e-12), shape(14)
    x[stencil[0, 1]] = x[stencil[0, 0]]
    pattern = BlockPattern(term.couplings, 14, 14)
    values = np.zeros((pattern.n_blocks, 3, 3))
    for convexity in (0.0, 1.0):
        term.add_hessian(x, None, Assembly(np.ones(len(stencil)), pattern.offsets, values, convexity))
    assert np.isfinite(term.energies(x)).all()
    assert np.isfinite(gradient(term, x, None)).all()
    assert np.isfinite(values).all()
