"""The registry of terms: when a scene needs a term, and which role the term has in the program.

A term is one module and one entry in ``REGISTRY``. The module has the functions ``elements(rest)`` (rank 0:
stencil and constants on the whole mesh, or None) and ``make(elements, scene, mass)`` (each rank: the term on
the rank's part). A module is imported, hence its kernels compiled, only when a scene needs the term.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, get_type_hints

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.scene.materials.library import ShellMaterial
from lyra_petsc.scene.schema import Scene, coefficients
from lyra_petsc.scene.time_curve import acts, is_curve
from lyra_petsc.terms.energies import BENDING, MEMBRANE, POTENTIAL

if TYPE_CHECKING:
    from lyra_petsc.mesh.elements import Elements
    from lyra_petsc.terms.term import Term

Need = Callable[[Scene, Sequence[ShellMaterial]], bool]


class Role(Enum):
    """Role of a term in the equations of motion."""

    ELASTIC = "elastic energy of the sheet"
    EXTERNAL = "energy whose work on the sheet comes from outside: springs of handles, friction on obstacles"
    VISCOUS = "potential of the velocities"
    LOAD = "force that is constant in a step"


@dataclass(frozen=True)
class Registration:
    """A term and the properties by which the rest of the program treats it.

    Attributes
    ----------
    name : str
        Name of the term, and of its module in ``lyra_petsc.terms`` unless ``module_name`` is given.
    needed : callable
        Returns whether a scene with these materials needs the term.
    role : Role
    energy : str
        Column of history.csv to which the term's energy [J] is added; a new column comes after the present
        ones. Empty for terms without an energy stored in the sheet (constraints, loads).
    columns : mapping of str to str
        Additional columns of history.csv, with the reduction of the ranks' values of ``Term.history``:
        ``sum``, ``min`` or ``max``.
    damped : bool
        Whether stiffness-proportional damping acts through the term.
    bends : bool
        Whether the term resists bending; without such a term sheets wrinkle as finely as their mesh.
    of_contact : bool
        Whether its elements are near pairs, which change: contact and its friction.
    coarse : str
        Name of the term that replaces this one on coarse levels of multigrid, which have no edge unknowns.
        This term's module then has ``coarse_elements(rest)``, the elements of that term.
    module_name : str
        Name of the term's module; with a leading dot it is relative to ``lyra_petsc.terms``.
    """

    name: str
    needed: Need
    role: Role
    energy: str = ""
    columns: Mapping[str, str] = field(default_factory=dict)
    damped: bool = False
    bends: bool = False
    of_contact: bool = False
    coarse: str = ""
    module_name: str = ""

    def module(self) -> ModuleType:
        """Import and return the term's module."""
        return import_module(self.module_name or f".{self.name}", __package__)

    @property
    def kind(self) -> type[Term]:
        """Class of the term, which its module's ``make`` declares to return."""
        returned: type[Term] = get_type_hints(self.module().make)["return"]
        return returned


def _bends_by(model: str) -> Need:
    return lambda scene, shells: any(shell.bends_with(model) for shell in shells)


def _has_clamped_hinges(scene: Scene, shells: Sequence[ShellMaterial]) -> bool:
    return any(s.bends_with("hinge") for s in shells) and any(handle.clamp for handle in scene.handles)


def _has_contact_friction(scene: Scene, shells: Sequence[ShellMaterial]) -> bool:
    if scene.contact is None:
        return False
    of_obstacles = [obstacle.friction for obstacle in (scene.obstacles or {}).values()]
    frictions = [scene.contact.friction, *of_obstacles]
    return any(max(coefficients(friction)) > 0.0 for friction in frictions if friction is not None)


def _has_bending_friction(scene: Scene, shells: Sequence[ShellMaterial]) -> bool:
    return any(max(shell.friction_moment) > 0.0 for shell in shells)


def _yields_by(model: str) -> Need:
    return lambda scene, shells: any(
        shell.bends_with(model) and math.isfinite(shell.yield_curvature) for shell in shells
    )


def _has_yielding_clamps(scene: Scene, shells: Sequence[ShellMaterial]) -> bool:
    return _has_clamped_hinges(scene, shells) and _yields_by("hinge")(scene, shells)


REGISTRY: list[Registration] = [
    Registration("membrane", lambda scene, shells: True, Role.ELASTIC, MEMBRANE, damped=True),
    Registration(
        "bending",
        _bends_by("hinge"),
        Role.ELASTIC,
        BENDING,
        damped=True,
        bends=True,
        module_name=".bending.hinge",
    ),
    Registration(
        "midedge",
        _bends_by("midedge"),
        Role.ELASTIC,
        BENDING,
        damped=True,
        bends=True,
        coarse="bending",
        module_name=".bending.midedge",
    ),
    Registration(
        "midedge_friction",
        _has_bending_friction,
        Role.ELASTIC,
        BENDING,
        coarse="bending",
        module_name=".bending.midedge_friction",
    ),
    Registration(
        "hinge_plasticity",
        _yields_by("hinge"),
        Role.ELASTIC,
        BENDING,
        damped=True,
        bends=True,
        module_name=".bending.hinge_plasticity",
    ),
    Registration(
        "midedge_plasticity",
        _yields_by("midedge"),
        Role.ELASTIC,
        BENDING,
        damped=True,
        bends=True,
        coarse="bending",
        module_name=".bending.midedge_plasticity",
    ),
    Registration(
        "shear_friction",
        lambda scene, shells: any(shell.friction_force > 0.0 for shell in shells),
        Role.ELASTIC,
        MEMBRANE,
    ),
    Registration(
        "stretch_limit",
        lambda scene, shells: any(shell.stretch_limit < math.inf for shell in shells),
        Role.ELASTIC,
        MEMBRANE,
    ),
    Registration("seam", lambda scene, shells: bool(scene.seams), Role.ELASTIC, "seam_energy"),
    Registration(
        "seam_bending",
        lambda scene, shells: any(seam.angle != "free" for seam in scene.seams),
        Role.ELASTIC,
        BENDING,
        damped=True,
    ),
    Registration(
        "contact",
        lambda scene, shells: scene.contact is not None,
        Role.ELASTIC,
        "contact_energy",
        {"contacts": "sum", "smallest_gap": "min", "friction_work": "sum"},
        of_contact=True,
        module_name="lyra_petsc.contact.barrier",
    ),
    Registration(
        "friction",
        _has_contact_friction,
        Role.EXTERNAL,
        columns={"friction_work": "sum"},
        of_contact=True,
        module_name="lyra_petsc.contact.friction",
    ),
    Registration(
        "clamp",
        _has_clamped_hinges,
        Role.ELASTIC,
        BENDING,
        damped=True,
        bends=True,
        module_name=".bending.hinge_clamp",
    ),
    Registration(
        "creases",
        lambda scene, shells: bool(scene.creases),
        Role.ELASTIC,
        BENDING,
        damped=True,
    ),
    Registration(
        "chambers",
        lambda scene, shells: any(load.chamber for load in scene.loads),
        Role.ELASTIC,
        "gas_energy",
    ),
    Registration(
        "clamp_plasticity",
        _has_yielding_clamps,
        Role.ELASTIC,
        BENDING,
        damped=True,
        bends=True,
        module_name=".bending.clamp_plasticity",
    ),
    Registration(
        "attachments", lambda scene, shells: bool(scene.attachments), Role.ELASTIC, "attachment_energy"
    ),
    Registration(
        "spring",
        lambda scene, shells: any(h.stiffness is not None or h.fade > 0 for h in scene.handles),
        Role.EXTERNAL,
        module_name=".handles.spring",
    ),
    Registration(
        "gravity",
        lambda scene, shells: acts(scene.gravity) and not is_curve(scene.gravity),
        Role.LOAD,
        POTENTIAL,
        module_name=".loads.gravity",
    ),
    Registration(
        "varying_gravity",
        lambda scene, shells: acts(scene.gravity) and is_curve(scene.gravity),
        Role.LOAD,
        module_name=".loads.gravity",
    ),
    Registration(
        "wind",
        lambda scene, shells: bool(scene.wind and (scene.wind.density or scene.wind.drag)),
        Role.VISCOUS,
        module_name=".loads.wind",
    ),
    Registration(
        "pressure",
        lambda scene, shells: any(load.pressure is not None for load in scene.loads),
        Role.LOAD,
        module_name=".loads.pressure",
    ),
    Registration(
        "force",
        lambda scene, shells: any(load.force or load.traction for load in scene.loads),
        Role.LOAD,
        module_name=".loads.force",
    ),
    Registration(
        "moment",
        lambda scene, shells: any(load.moment is not None for load in scene.loads),
        Role.LOAD,
        module_name=".loads.moment",
    ),
]


def needed_terms(scene: Scene, shells: Sequence[ShellMaterial]) -> list[Registration]:
    """The terms that a scene with these materials needs, in the order of the registry."""
    return [entry for entry in REGISTRY if entry.needed(scene, shells)]


def registration_of(name: str) -> Registration:
    """The registration of the term of this name."""
    return next(entry for entry in REGISTRY if entry.name == name)


def make_term(
    entry: Registration, elements: Elements | None, scene: Scene, mass: NDArray[np.float64], name: str = ""
) -> Term:
    """The term on one rank, from its elements there and the mass (n_vertices,) [kg] of the vertices; ``name``
    instead of its own.
    """
    term: Term = entry.module().make(elements, scene, mass)
    term.registration = replace(entry, name=name) if name else entry
    return term
