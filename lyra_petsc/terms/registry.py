"""Every term, and when a scene needs it. A term is one module here and one line in ``REGISTRY``.

A term's module offers ``elements(rest)`` (rank 0: its stencil and constants on the whole mesh, or
None) and ``make(elements, scene, mass)`` (each rank: the term on its own part). A module is imported,
hence its kernels compiled, only when a scene needs the term.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType

from lyra_petsc.materials.shell import ShellMaterial
from lyra_petsc.scene.schema import Scene

Need = Callable[[Scene, Sequence[ShellMaterial]], bool]


@dataclass(frozen=True)
class Registration:
    """A term's name (also its module) and whether a scene needs it."""

    name: str
    needed: Need

    def module(self) -> ModuleType:
        """The term's module, imported now."""
        return import_module(f"lyra_petsc.terms.{self.name}")


def _bends(scene: Scene, shells: Sequence[ShellMaterial]) -> bool:
    return any(max(shell.bending) > 0.0 for shell in shells)


REGISTRY = (
    Registration("membrane", lambda scene, shells: True),
    Registration("bending", _bends),
    Registration(
        "clamp", lambda scene, shells: _bends(scene, shells) and any(h.clamp for h in scene.handles)
    ),
    Registration(
        "spring", lambda scene, shells: any(h.stiffness is not None or h.fade > 0 for h in scene.handles)
    ),
    Registration("gravity", lambda scene, shells: scene.gravity is not None and any(scene.gravity)),
    Registration("wind", lambda scene, shells: bool(scene.wind and (scene.wind.density or scene.wind.drag))),
    Registration("pressure", lambda scene, shells: any(load.pressure is not None for load in scene.loads)),
    Registration("force", lambda scene, shells: any(load.force or load.traction for load in scene.loads)),
)


def active(scene: Scene, shells: Sequence[ShellMaterial]) -> list[Registration]:
    """The terms a scene needs, in the order of the registry."""
    return [entry for entry in REGISTRY if entry.needed(scene, shells)]
