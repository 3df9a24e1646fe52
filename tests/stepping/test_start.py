"""The state at t = 0."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from physics import CLOTH, Simulation, grid

from lyra_petsc.errors import InputError

MESH = {
    "grid": {"width": 1, "height": 1, "nx": 6, "ny": 6},
    "transform": {"rotate": {"axis": [1, 0, 0], "degrees": 90}},
}


@pytest.mark.parallel(2)
def test_spin_is_about_the_centre_of_mass(comm: MPI.Comm) -> None:
    content = {
        "mesh": [
            grid(1, 1, 2, 2),
            grid(1, 1, 1, 1) | {"name": "heavy", "transform": {"translate": [3, 0, 0]}},
        ],
        "material": [CLOTH, CLOTH | {"density": 1.0, "group": "heavy"}],
        "initial": {"velocity": [0, 1, 0], "angular_velocity": [0, 0, 2]},
    }
    with Simulation(content, comm) as simulation:
        mass = simulation.mass[:, None]
        x, v = simulation.x, simulation.v
        centre = (mass * x).sum(axis=0) / mass.sum()
        assert centre[0] == pytest.approx((0.2 * 0.5 + 1.0 * 3.5) / 1.2)
        np.testing.assert_allclose(v, np.cross([0, 0, 2.0], x - centre) + [0, 1, 0], atol=1e-14)
        np.testing.assert_allclose((mass * v).sum(axis=0), [0, 1.2, 0], atol=1e-14)


def test_noise_is_normal_to_the_sheet_with_the_given_size() -> None:
    content = {
        "mesh": MESH | {"grid": MESH["grid"] | {"nx": 20, "ny": 20}},
        "initial": {"noise": 1e-3, "seed": 1},
    }
    with (
        Simulation(content, MPI.COMM_SELF) as noisy,
        Simulation({"mesh": content["mesh"]}, MPI.COMM_SELF) as flat,
    ):
        shift = noisy.x - flat.x
    np.testing.assert_allclose(shift[:, [0, 2]], 0.0, atol=1e-15)  # the sheet is in the xz plane
    assert np.std(shift[:, 1]) == pytest.approx(1e-3, rel=0.1)
    assert abs(np.mean(shift[:, 1])) < 2e-4


def test_the_seed_determines_the_noise() -> None:
    def shape(seed: int) -> np.ndarray:
        with Simulation(
            {"mesh": MESH, "initial": {"noise": 1e-3, "seed": seed}}, MPI.COMM_SELF
        ) as simulation:
            return simulation.x

    np.testing.assert_array_equal(shape(3), shape(3))
    assert np.abs(shape(3) - shape(4)).max() > 1e-4


def test_noise_does_not_change_the_rest_shape() -> None:
    with Simulation({"mesh": MESH, "initial": {"noise": 1e-3}}, MPI.COMM_SELF) as simulation:
        assert simulation.energy("membrane") > 0.0


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"initial": {"angular_velocity": [0, 0, 1e9]}}, "initial.angular_velocity"),
        ({"initial": {"angular_velocity": [0, 1e200, 1e200]}}, "initial.angular_velocity"),
        ({"mesh": MESH | {"transform": {"translate": [1e12, 0, 0]}}}, "mesh"),
    ],
)
def test_sizes_below_double_precision_are_refused(change: dict[str, Any], key: str) -> None:
    with pytest.raises(InputError) as refused:
        Simulation({"mesh": MESH} | change, MPI.COMM_SELF)
    assert refused.value.key == key


def test_a_sheet_far_away_is_simulated() -> None:
    far = MESH | {"transform": {"translate": [1e8, 0, 0]}}
    with Simulation({"mesh": far, "initial": {"velocity": [1e7, 0, 0]}}, MPI.COMM_SELF) as simulation:
        assert np.isfinite(simulation.x).all()


def test_a_motion_that_is_too_fast_is_refused() -> None:
    content = {"mesh": MESH, "handles": [{"nodes": [0], "motion": "m"}]}
    content["motions"] = {"m": [{"time": 0}, {"time": 1e-3, "translate": [0, 1e6, 0]}]}
    with pytest.raises(InputError, match=r"1e\+09 m/s from keyframe 0 to 1") as refused:
        Simulation(content, MPI.COMM_SELF)
    assert refused.value.key == "motions.m"
