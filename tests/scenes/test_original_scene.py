"""A scene of the original Lyra runs unchanged and agrees with it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from original_lyra import simulate

from lyra_petsc.cli.run import run
from lyra_petsc.output.read_run import StoredRun

SIDE = 16
CONF = """{
    // a square of 1 m, hung by two corners
    "frame_time": 0.04, "frame_steps": 8, "end_time": 0.2,   /* Δt 5 ms */
    "cloths": [{
        "mesh": "meshes/square.obj",
        "transform": {"translate": [0, 0, 0]},
        "materials": [{"data": "%s", "damping": 0.03}]
    }],
    "handles": [{"nodes": [240, 255]}],
    "gravity": [0, 0, -9.8],
}
"""


def square() -> tuple[np.ndarray, np.ndarray]:
    """Positions (V, 2) and triangles of the sheet."""
    u, v = np.meshgrid(np.linspace(0, 1, SIDE), np.linspace(0, 1, SIDE))
    triangles = []
    for j in range(SIDE - 1):
        for i in range(SIDE - 1):
            a = j * SIDE + i
            triangles += [[a, a + 1, a + SIDE + 1], [a, a + SIDE + 1, a + SIDE]]
    return np.column_stack([u.ravel(), v.ravel()]), np.array(triangles)


@pytest.mark.parametrize("material", ["materials/isotropic.json", "isotropic"])
def test_hanging_square_agrees_with_the_original(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, material: str
) -> None:
    uv, triangles = square()
    (tmp_path / "meshes").mkdir()
    lines = [f"v {x!r} {y!r} 0" for x, y in uv.tolist()] + [f"vt {x!r} {y!r}" for x, y in uv.tolist()]
    lines += ["f " + " ".join(f"{k + 1}/{k + 1}" for k in triangle) for triangle in triangles.tolist()]
    (tmp_path / "meshes" / "square.obj").write_text("\n".join(lines) + "\n")
    (tmp_path / "conf.json").write_text(CONF % material)
    monkeypatch.chdir(tmp_path)

    run(MPI.COMM_SELF, tmp_path / "conf.json", [], out=None, force=False, resume=False)

    found = StoredRun(tmp_path / "runs" / "conf")
    assert found.times[5] == pytest.approx(0.2, abs=1e-12)
    ours = found.positions[5]
    theirs = simulate(
        np.column_stack([uv, np.zeros(len(uv))]),
        uv,
        triangles,
        [240, 255],
        density=0.1,
        c=(40.0, 0.0, 40.0, 40.0),
        k_e=2e-5,
        gamma=0.03,
        gravity=(0.0, 0.0, -9.8),
        dt=0.005,
        steps=40,
    )
    assert np.abs(ours[:, 2]).max() > 0.1  # it has fallen
    assert np.abs(ours - theirs).max() < 1e-5  # the 2 mm asked for are for its own last digits
