"""The sheet that is stressed when no scene is given: a square metre of cotton, hung by two corners."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from lyra_petsc.errors import InputError
from lyra_petsc.experiments.stress.case import Content, Level, Setting
from lyra_petsc.scene.load import dump_scene, load_scene
from lyra_petsc.scene.messages import input_error
from lyra_petsc.scene.overrides import apply_overrides
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.text import parse_yaml

CELLS = {Level.QUICK: 20, Level.USUAL: 40, Level.FULL: 40}
"""Along a side."""

STEP = 0.005
"""Δt [s], also of a given scene whose steps follow a tolerance."""

DENSITY, STIFFNESS, BENDING, DAMPING = 0.15, 120.0, 1e-5, 0.005
"""kg/m², N/m, N·m, s"""


def sheet(cells: int) -> Content:
    """The scene."""
    return {
        "title": "A square of cotton hung by two corners",
        "mesh": {"grid": {"width": 1.0, "height": 1.0, "nx": cells, "ny": cells, "pattern": "alternating"}},
        "material": {
            "density": DENSITY,
            "membrane": {
                "c11": STIFFNESS,
                "c22": STIFFNESS,
                "c12": STIFFNESS / 3.0,
                "c33": 0.25 * STIFFNESS,
            },
            "bending": BENDING,
            "damping": DAMPING,
        },
        "gravity": [0.0, 0.0, -9.81],
        "handles": [{"nodes": [0, cells]}],
        "time": {"end": 20 * STEP, "step": STEP},
    }


def setting_of(
    scene: Path | None, settings: Sequence[str], level: Level, *, trust_mesh: bool = False
) -> Setting:
    """What the cases start from. On one rank.

    Raises
    ------
    InputError
        For a scene that cannot be used, or is not stepped through time.
    """
    if scene is None:
        data: dict[str, Any] = sheet(CELLS[level])
        overridden = apply_overrides(data, settings)
        try:
            checked = Scene.model_validate(data)
        except ValidationError as error:
            raise input_error(error, data, file=None, overridden=overridden) from None
    else:
        checked = load_scene(scene, settings)
    if checked.time.analysis == "static":
        raise InputError(
            "stress tests motions; give --set time.analysis=dynamic --set time.step=0.005",
            file=scene,
            key="time.analysis",
        )
    content: Content = parse_yaml(dump_scene(checked), file=None)
    if checked.time.adaptive:
        content["time"] |= {"step": STEP}
        content["time"].pop("tolerance")
    for key in ("output", "probes"):
        content.pop(key, None)
    return Setting(content, scene is not None, level, trust_mesh=trust_mesh)
