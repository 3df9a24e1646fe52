"""Handles that together hold more vertices than fit into memory."""

from __future__ import annotations

import pytest

from lyra_petsc.errors import InputError
from lyra_petsc.mesh.build import build_mesh
from lyra_petsc.scene.schema import Scene
from lyra_petsc.terms.handles import prescribed_handles as held

SCENE = {
    "mesh": {"grid": {"width": 1, "height": 1, "nx": 4, "ny": 4}},
    "material": {"cloth": "paper"},
    "time": {"end": 1, "step": 0.1},
    "handles": [{"group": "sheet"}] * 10,
}


def test_many_handles_on_many_vertices_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene.model_validate(SCENE)
    mesh = build_mesh(scene.mesh)
    assert sum(len(vertices) for vertices in held.select_exact(scene, mesh).values()) == 250
    monkeypatch.setattr(held, "available_memory", lambda: 12_000)
    with pytest.raises(InputError, match="hold 125 vertices in all") as caught:
        held.select_exact(scene, mesh)
    assert caught.value.key == "handles[4]"
