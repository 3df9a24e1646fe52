"""Every term: when a scene needs it, and what it is to the rest of the program.

A term is one module and one entry in ``REGISTRY``. The module offers ``elements(rest)`` (rank 0: its stencil
and constants on the whole mesh, or None) and ``make(elements, scene, mass)`` (each rank: the term on its own
part). A module is imported, hence its kernels compiled, only when a scene needs the term.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.scene.materials.library import ShellMaterial
from lyra_petsc.scene.schema import Scene, coefficients

if TYPE_CHECKING:
    from lyra_petsc.mesh.elements import Elements
    from lyra_petsc.terms.term import Term

Need = Callable[[Scene, Sequence[ShellMaterial]], bool]


class Role(Enum):
    """What a term is in the equations of motion."""

    ELASTIC = "elastic energy of the sheet"
    CONSTRAINT = "elastic energy by which handles pull: its work comes from outside"
    VISCOUS = "potential of the velocities"
    LOAD = "force that is constant in a step"


@dataclass(frozen=True)
class Registration:
    """A term, and what the rest of the program needs to know of it.

    Attributes
    ----------
    name : str
        Also that of its module in ``lyra_petsc.terms``, unless ``home`` names another.
    needed : callable
        Whether a scene with these materials needs it.
    role : Role
    energy : str
        Column of history.csv that its energy [J] is added to; a new one comes after the present columns.
        Empty where it is not stored in the sheet (constraints) or there is none.
    columns : mapping of str to str
        Further columns of history.csv, and how the ranks' parts of ``Term.history`` become one number:
        ``sum``, ``min`` or ``max``.
    damped : bool
        Stiffness-proportional damping acts through it.
    bends : bool
        It resists bending: without such a term sheets wrinkle as finely as their mesh.
    moving : bool
        Its energy depends on where moving handles stand, which thereby do work on the sheet.
    neighbours : bool
        Its stencils change as points come near to each other.
    limits_step : bool
        It limits how far a Newton iteration may go.
    state, edge_state : tuple of str
        Names of the arrays that a checkpoint must hold for it, of vertices and of edges with an unknown.
    element_vertices : int
        Vertices of each of its elements, where a checkpoint must hold something of them.
    coarse : str
        The term that stands for it on coarse levels of multigrid, which have no unknowns of edges. Its module
        offers ``coarse_elements(rest)``, of that term.
    home : str
        Full name of its module, where that is elsewhere.
    """

    name: str
    needed: Need
    role: Role
    energy: str = ""
    columns: Mapping[str, str] = field(default_factory=dict)
    damped: bool = False
    bends: bool = False
    moving: bool = False
    neighbours: bool = False
    limits_step: bool = False
    state: tuple[str, ...] = ()
    edge_state: tuple[str, ...] = ()
    element_vertices: int = 0
    coarse: str = ""
    home: str = ""

    def module(self) -> ModuleType:
        """The term's module, imported now."""
        return import_module(self.home or f"lyra_petsc.terms.{self.name}")


def _bends_by(model: str) -> Need:
    return lambda scene, shells: any(shell.bends_with(model) for shell in shells)


def _clamps(scene: Scene, shells: Sequence[ShellMaterial]) -> bool:
    return any(s.bends_with("hinge") for s in shells) and any(handle.clamp for handle in scene.handles)


def _rubs(scene: Scene, shells: Sequence[ShellMaterial]) -> bool:
    own = [obstacle.friction for obstacle in (scene.obstacles or {}).values()]
    all_of_them = [] if scene.contact is None else [scene.contact.friction, *own]
    return any(max(coefficients(each)) > 0.0 for each in all_of_them if each is not None)


def _slides(scene: Scene, shells: Sequence[ShellMaterial]) -> bool:
    return any(max(shell.friction_moment) > 0.0 for shell in shells)


REGISTRY: list[Registration] = [
    Registration("membrane", lambda scene, shells: True, Role.ELASTIC, "membrane_energy", damped=True),
    Registration("bending", _bends_by("hinge"), Role.ELASTIC, "bending_energy", damped=True, bends=True),
    Registration(
        "midedge",
        _bends_by("midedge"),
        Role.ELASTIC,
        "bending_energy",
        damped=True,
        bends=True,
        edge_state=("frame",),
        coarse="bending",
    ),
    Registration(
        "midedge_friction",
        _slides,
        Role.ELASTIC,
        "bending_energy",
        element_vertices=3,
        coarse="bending",
    ),
    Registration(
        "shear_friction",
        lambda scene, shells: any(shell.friction_force > 0.0 for shell in shells),
        Role.ELASTIC,
        "membrane_energy",
        element_vertices=3,
    ),
    Registration(
        "contact",
        lambda scene, shells: scene.contact is not None,
        Role.ELASTIC,
        "contact_energy",
        {"contacts": "sum", "smallest_gap": "min", "friction_work": "sum"},
        neighbours=True,
        limits_step=True,
    ),
    Registration(
        "friction",
        _rubs,
        Role.CONSTRAINT,
        columns={"friction_work": "sum"},
        neighbours=True,
        state=("friction_work", "friction_owed"),
        element_vertices=4,
    ),
    Registration("clamp", _clamps, Role.ELASTIC, "bending_energy", damped=True, bends=True, moving=True),
    Registration(
        "spring",
        lambda scene, shells: any(h.stiffness is not None or h.fade > 0 for h in scene.handles),
        Role.CONSTRAINT,
    ),
    Registration(
        "gravity",
        lambda scene, shells: scene.gravity is not None and any(scene.gravity),
        Role.LOAD,
        "potential_energy",
    ),
    Registration(
        "wind",
        lambda scene, shells: bool(scene.wind and (scene.wind.density or scene.wind.drag)),
        Role.VISCOUS,
    ),
    Registration(
        "pressure", lambda scene, shells: any(load.pressure is not None for load in scene.loads), Role.LOAD
    ),
    Registration(
        "force", lambda scene, shells: any(load.force or load.traction for load in scene.loads), Role.LOAD
    ),
    Registration(
        "moment", lambda scene, shells: any(load.moment is not None for load in scene.loads), Role.LOAD
    ),
]


def active(scene: Scene, shells: Sequence[ShellMaterial]) -> list[Registration]:
    """The terms a scene needs, in the order of the registry."""
    return [entry for entry in REGISTRY if entry.needed(scene, shells)]


def registered(name: str) -> Registration:
    """The entry of a term."""
    return next(entry for entry in REGISTRY if entry.name == name)


def made(entry: Registration, elements: Elements | None, scene: Scene, mass: NDArray[np.float64]) -> Term:
    """A term on one rank, of its elements there and the mass (n_vertices,) [kg] of the vertices."""
    term: Term = entry.module().make(elements, scene, mass)
    term.registration = entry
    return term
