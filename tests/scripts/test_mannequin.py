"""The mannequin: a closed body, and a walk that begins with the body at rest."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pyvista

SCRIPT = Path(__file__).parents[2] / "scripts" / "mannequin.py"


def test_the_body_is_closed_and_walks(tmp_path: Path) -> None:
    words = ["--triangles", "3000", "--frames", "40", "--fps", "20"]
    subprocess.run([sys.executable, SCRIPT, tmp_path, *words], check=True, capture_output=True)
    body = pyvista.read(tmp_path / "body.obj")
    assert 2400 < body.n_cells < 3600
    assert body.is_manifold
    assert body.n_open_edges == 0
    assert 0.03 < body.volume < 0.09  # m³
    with np.load(tmp_path / "walk.npz") as frames:
        time, position = frames["time"], frames["position"]
    np.testing.assert_allclose(time, np.arange(40) / 20.0)
    np.testing.assert_allclose(position[0], body.points, atol=1e-6)
    moved = np.linalg.norm(position - position[0], axis=2)
    assert 0.25 < moved[20:].max() < 1.0
    assert moved[:, body.points[:, 2] > 1.5].max() < 1e-6  # the head stays
    speed = np.linalg.norm(np.diff(position, axis=0), axis=2).max(axis=1) * 20.0
    assert speed[0] < 0.1
    assert speed.max() < 4.0
