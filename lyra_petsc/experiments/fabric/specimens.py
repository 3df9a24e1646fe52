"""Materials to be tested, as blocks of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lyra_petsc.errors import InputError, suggest
from lyra_petsc.scene.dump import dump_scene
from lyra_petsc.scene.load import load_scene, scene_of
from lyra_petsc.scene.material_block import Material
from lyra_petsc.scene.materials.library import ShellMaterial, material_names, measured_names, resolve_material
from lyra_petsc.scene.messages import validated
from lyra_petsc.scene.text import parse_yaml

G = 9.80665
"""Standard gravity [m/s²], which defines the gram-force"""


@dataclass(frozen=True)
class Fabric:
    """A material under test.

    Attributes
    ----------
    name : str
        Name for reports.
    block : dict
        Material block of a scene, with directors on edges.
    """

    name: str
    block: dict[str, Any]

    def turned(self, degrees: float) -> dict[str, Any]:
        """Material block for a specimen whose length is at this angle to the warp, not the scene's."""
        return self.block | {"warp_degrees": -degrees}

    def shell(self, degrees: float = 0.0) -> ShellMaterial:
        """Constants of the material; directions 1 and 2 are exchanged at 90°."""
        shell = resolve_material(validated(Material, self.block, file=self.name))[0]
        return shell if degrees == 0.0 else _exchanged(shell)

    def rigidity(self, degrees: float) -> float:
        """Bending stiffness B [N·m] of a narrow strip along a direction."""
        d11, d12, d22, _ = self.shell(degrees).plate
        return d11 - d12**2 / d22 if d22 > 0.0 else 0.0

    @property
    def bends(self) -> bool:
        """Whether the material resists bending."""
        return self.rigidity(0.0) > 0.0

    def needs_bending(self, test: str) -> None:
        """Refuse a test of bending if the material has no bending stiffness.

        Raises
        ------
        InputError
        """
        if not self.bends:
            raise InputError(
                f"the test {test} is of bending, which this material does not resist", key=self.name
            )


def _exchanged(shell: ShellMaterial) -> ShellMaterial:
    d11, d12, d22, d33 = shell.plate
    moments = shell.friction_moment
    return replace(
        shell,
        curves=(*shell.curves[1::-1], *shell.curves[2:]),
        c11=shell.c22,
        c22=shell.c11,
        plate=(d22, d12, d11, d33),
        friction_moment=(moments[1], moments[0]),
    )


def fabric_of(material: str, settings: Sequence[str] = ()) -> Fabric:
    """A cloth of the library, with its measured law if it has one, or the first material of a scene.

    Raises
    ------
    InputError
        Unknown name, a scene that cannot be used.
    """
    path = Path(material)
    if material in material_names():
        data = {
            "mesh": {"grid": {"width": 1.0, "height": 1.0, "nx": 1, "ny": 1}},
            "material": {"cloth": material} | ({"law": "measured"} if material in measured_names() else {}),
            "time": {"end": 1.0, "step": 1.0},
        }
        scene = scene_of(data)
        if settings:
            raise InputError("changes a scene; give one instead of a cloth's name", key="--set")
    elif path.suffix in (".yaml", ".yml", ".json") or path.exists():
        scene = load_scene(path, settings)
    else:
        raise InputError(
            f"no cloth of the library and no scene file, {suggest(material, material_names())}", key=material
        )
    block = dict(parse_yaml(dump_scene(scene), file=path)["material"][0])
    for key in ("group", "rest_curvature"):
        block.pop(key, None)
    return Fabric(material, block | {"bending_model": "midedge"})
