"""A scene gives the same answer on any number of ranks."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from physics import CLOTH, Simulation, grid

from lyra_petsc.linear.presets import BETWEEN_RANKS, PRESETS
from lyra_petsc.mesh import distribute
from lyra_petsc.stepping.energy_balance import EnergyBalance

pytestmark = [pytest.mark.parallel, pytest.mark.quick]

SHEET: dict[str, Any] = {
    "mesh": grid(1.0, 0.8, 7, 5, "alternating"),
    "material": CLOTH | {"bending": [1e-3, 2e-3, 1e-3], "damping": 0.02, "warp_degrees": 15},
    "gravity": [0, 0, -9.81],
    "wind": {"velocity": [1, 2, 3], "density": 1.2, "drag": 0.1},
    "handles": [
        {"nodes": [0, 8, 16, 24], "clamp": True, "motion": "turn"},
        {"nodes": [47], "axes": ["z"], "until": 0.05, "fade": 0.02},
        {"nodes": [7], "stiffness": 100},
    ],
    "motions": {"turn": [{"time": 0}, {"time": 0.1, "rotate": {"axis": [0, 1, 0], "degrees": 10}}]},
    "loads": [{"pressure": 3.0}, {"nodes": [20], "force": [0, 0.2, 0]}],
    "initial": {"noise": 0.002, "velocity": [0, 0.3, 0]},
}

TWO_SHEETS = {
    "mesh": [
        {"grid": {"width": 1, "height": 0.3, "nx": 6, "ny": 2, "pattern": "criss-cross"}, "name": "a"},
        {
            "grid": {"width": 0.5, "height": 0.5, "nx": 3, "ny": 3},
            "name": "b",
            "transform": {"translate": [0, 2, 0]},
        },
    ],
    "material": [CLOTH | {"group": "a"}, CLOTH | {"density": 0.5, "bending": 1e-3}],
    "gravity": [0, 0, -9.81],
    "handles": [{"nodes": [0, 1]}, {"box": [[-0.1, 1.9, -1], [0.6, 2.01, 1]]}],
}

TINY = {"mesh": grid(1, 1, 1, 1), "gravity": [0, 0, -9.81], "handles": [{"nodes": [0]}]}


def outcome(
    content: dict[str, Any], comm: MPI.Comm, steps: int
) -> tuple[np.ndarray, np.ndarray, list[float]]:
    """Positions, velocities and energies after some steps."""
    with Simulation(content, comm) as simulation:
        energy_balance = EnergyBalance(simulation.equations)
        n = simulation.equations.points.n_owned
        for _ in range(steps):
            x = simulation.equations.x[:n].copy()
            simulation.step(0.01)
            energy_balance.record(x)
        return (
            simulation.x,
            simulation.v,
            [value for key, value in vars(energy_balance.budget).items() if key != "more"],
        )


@pytest.mark.parallel(alone=False)
@pytest.mark.parametrize("integrator", ["beuler", "semi-implicit"])
@pytest.mark.parametrize("content", [SHEET, TWO_SHEETS, TINY], ids=["sheet", "two", "tiny"])
def test_ranks_agree_with_one_rank(comm: MPI.Comm, content: dict[str, Any], integrator: str) -> None:
    content = content | {"time": {"end": 1.0, "step": 0.01, "integrator": integrator}}
    x, v, budget = outcome(content, comm, 8)
    x1, v1, budget1 = outcome(content, MPI.COMM_SELF, 8)
    start = outcome(content, MPI.COMM_SELF, 0)[0]
    assert np.abs(x1 - start).max() > 0.01  # something happened
    np.testing.assert_allclose(x, x1, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(v, v1, rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(budget, budget1, rtol=0.0, atol=1e-7 * np.abs(budget1).max())


@pytest.mark.parametrize("options", [{"pc_type": "pbjacobi"}, {"pc_type": "bjacobi"}, {"pc_type": "gamg"}])
def test_iterative_solvers_give_the_same_answer(comm: MPI.Comm, options: dict[str, str]) -> None:
    with Simulation(TWO_SHEETS, comm) as direct:
        expected = direct.run(0.01, 4)
    with Simulation(TWO_SHEETS, comm, options) as simulation:
        np.testing.assert_allclose(simulation.run(0.01, 4), expected, rtol=0.0, atol=1e-8)


def test_start_noise_does_not_depend_on_the_ranks_and_spares_held_vertices(comm: MPI.Comm) -> None:
    content = TWO_SHEETS | {"initial": {"noise": 0.01, "seed": 5}}
    with Simulation(TWO_SHEETS, comm) as simulation:
        flat = simulation.x
    with Simulation(content, comm) as one, Simulation(content, MPI.COMM_SELF) as two:
        np.testing.assert_array_equal(one.x, two.x)
        shift = one.x - flat
    assert np.abs(shift[:, :2]).max() == 0.0
    held = np.isin(np.arange(len(flat)), [0, 1]) | (np.abs(flat[:, 1] - 2.0) < 0.01)
    assert np.abs(shift[held]).max() == 0.0
    assert np.std(shift[~held, 2]) == pytest.approx(0.01, rel=0.3)


@pytest.mark.parametrize("preset", [name for name in PRESETS if name not in ("cholesky", "ilu")])
def test_ranks_without_vertices(comm: MPI.Comm, preset: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if preset == "direct" and not PETSc.Sys.hasExternalPackage("mumps"):
        pytest.skip("PETSc has no MUMPS")
    with Simulation(TINY, MPI.COMM_SELF) as direct:
        expected = direct.run(0.01, 3)
    partition = distribute.partition

    def all_to_the_last(comm: MPI.Comm, graph: Any, n: int, places: Any) -> tuple[Any, str]:
        owners, name = partition(comm, graph, n, places)
        return (None if owners is None else np.full(n, comm.size - 1)), name

    monkeypatch.setattr(distribute, "partition", all_to_the_last)
    options = PRESETS[preset] | BETWEEN_RANKS.get(preset, {})
    with Simulation(TINY, comm, {name: str(value) for name, value in options.items()}) as simulation:
        np.testing.assert_allclose(simulation.run(0.01, 3), expected, rtol=0.0, atol=1e-8)
