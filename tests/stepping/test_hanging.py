"""Hanging strips: the discrete chain, its continuum limit, and the catenary."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import Simulation, grid, reference

HANGING = reference("hanging")
WIDTH = 0.1


def strip(nx: int, e: float, **more: Any) -> dict[str, Any]:
    """A strip of unit length along x whose weight is e times its stiffness, c12 = 0."""
    stiffness = 100.0
    membrane = {"c11": stiffness, "c22": stiffness, "c12": 0.0, "c33": 0.5 * stiffness}
    density = e * stiffness / 9.81
    return {
        "mesh": grid(1.0, WIDTH, nx, 1),
        "material": {"density": density, "membrane": membrane},
        "solver": {"force_tolerance": 1e-9, "step_tolerance": 1e-9, "max_iterations": 200},
    } | more


def elongation(nx: int, e: float) -> float:
    """Elongation of a strip hanging from its left edge, with its weight lumped to the rows."""
    weight = e * 100.0 * WIDTH
    rows = [{"box": [[i / nx - 1e-6, -1, -1], [i / nx + 1e-6, 1, 1]]} for i in range(nx + 1)]
    shares = np.full(nx + 1, 1.0 / nx)
    shares[[0, -1]] *= 0.5
    loads = [row | {"force": [weight * share, 0, 0]} for row, share in zip(rows, shares, strict=True)]
    side = {"group": "sheet", "axes": ["y", "z"]}  # c12 = 0: no need to contract
    with Simulation(strip(nx, e, loads=loads, handles=[rows[0], side]), MPI.COMM_SELF) as simulation:
        x = simulation.run(100.0, 8)
        tip = x[[nx, 2 * nx + 1], 0]
    assert tip[0] == pytest.approx(tip[1], abs=1e-12)
    return float(tip[0]) - 1.0


@pytest.mark.parametrize(
    ("e", "n", "exact"), [row for row in HANGING["chain"]["rows"] if row[1] in (1, 4, 16)]
)
def test_a_strip_hangs_as_a_chain_of_bars(e: float, n: int, exact: float) -> None:
    assert elongation(n, e) == pytest.approx(exact, rel=1e-10, abs=1e-12)


@pytest.mark.parametrize(("e", "exact"), HANGING["strip"]["rows"])
def test_strip_converges_with_the_square_of_the_element_size(e: float, exact: float) -> None:
    sizes = [8, 16, 32]
    errors = [abs(elongation(n, e) - exact) for n in sizes]
    slope = -np.polyfit(np.log(sizes), np.log(errors), 1)[0]
    assert slope == pytest.approx(2.0, abs=0.2)
    assert errors[-1] < 2e-3 * exact


def test_a_strip_under_gravity() -> None:
    # lumped masses of a diagonal grid differ at the corners: equal to the chain but for that
    content = strip(
        16, 0.1, gravity=[9.81, 0, 0], handles=[{"group": "left"}, {"group": "sheet", "axes": ["y", "z"]}]
    )
    with Simulation(content, MPI.COMM_SELF) as simulation:
        x = simulation.run(100.0, 8)
    exact = next(row[2] for row in HANGING["chain"]["rows"] if row[:2] == [0.1, 16])
    assert x[[16, 33], 0].mean() - 1.0 == pytest.approx(exact, rel=1e-3)


def sag(nx: int, e: float, span: float) -> float:
    """Sag over the length of a strip whose ends have approached each other."""
    content = strip(
        nx,
        e,
        gravity=[0, 0, -9.81],
        handles=[{"group": "left"}, {"group": "right", "motion": "in"}, {"group": "sheet", "axes": ["y"]}],
        motions={"in": [{"time": 0}, {"time": 1, "translate": [span - 1.0, 0, 0]}]},
        initial={"velocity": [0, 0, -0.5]},
    )
    with Simulation(content, MPI.COMM_SELF) as simulation:
        simulation.run(0.1, 10)
        x = simulation.run(2.0, 25)
        assert np.abs(simulation.v).max() < 1e-8
        np.testing.assert_allclose(x[nx, 0], span, atol=1e-14)
    return float(-x[:, 2].min())


@pytest.mark.slow
@pytest.mark.parametrize(("e", "span"), [(0.01, 0.8), (0.1, 0.5)])
def test_catenary(e: float, span: float) -> None:
    exact = next(row[2] for row in HANGING["catenary"]["rows"] if row[:2] == [e, span])
    errors = [abs(sag(nx, e, span) - exact) for nx in (8, 16, 32)]
    # a polygon of n bars: the sag errs by about (1/n)²/8 of the curvature's
    assert errors[-1] < 1e-3 * exact
    assert errors[0] > 3.0 * errors[1] > 9.0 * errors[2]
