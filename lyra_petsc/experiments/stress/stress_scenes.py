"""A case of ``stress``: an extreme scene, made of the user's or of a hung square of cotton, and what it
must keep.

Functions that change a scene work on the keys of a scene file, in place.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError
from lyra_petsc.experiments.bench import Bench, Trial
from lyra_petsc.experiments.case import Case, Verdict
from lyra_petsc.scene.dump import dump_scene
from lyra_petsc.scene.load import load_scene
from lyra_petsc.scene.materials.library import resolve_material
from lyra_petsc.scene.messages import validated
from lyra_petsc.scene.overrides import apply_overrides
from lyra_petsc.scene.schema import Material, Scene
from lyra_petsc.scene.text import parse_yaml

if TYPE_CHECKING:
    from lyra_petsc.experiments.stress.step_balance import Record

Content = dict[str, Any]


class Scope(IntEnum):
    """How much is run: each includes those before."""

    QUICK = 0
    USUAL = 1
    FULL = 2


QUICK, USUAL, FULL = Scope


@dataclass(frozen=True)
class Setting:
    """What the cases of one ``stress`` start from.

    Attributes
    ----------
    base : dict
        The scene whose changes the cases are, in the keys of a scene file.
    given : bool
        It is the user's; else the hanging sheet of `lyra_petsc.experiments.stress.stress_scenes`.
    level : Scope
    size : float
        Diagonal of the rest shape's bounding box [m].
    trust_mesh : bool
        Give gmsh the scene's scripts whatever they say.
    """

    base: Content
    given: bool
    level: Scope
    size: float = math.sqrt(2.0)
    trust_mesh: bool = False

    def content(self) -> Content:
        """A copy of the base scene, to be changed."""
        return copy.deepcopy(self.base)

    def bench(self, comm: MPI.Comm, watch: Callable[[], None] | None) -> Bench:
        """Where its scenes run as a user's do."""
        return Bench(comm, watch, direct=False, trust_mesh=self.trust_mesh)

    @property
    def step(self) -> float:
        """The base scene's Δt [s]."""
        return float(self.base["time"]["step"])


class NotApplicable(Exception):
    """A case that makes no sense for the scene at hand; says why."""


Maker = Callable[[Setting, Bench], Content]
Shaper = Callable[[Array, float], Array]
Judge = Callable[[Setting, Bench, "Record"], Mapping[str, Verdict]]


@dataclass(frozen=True)
class StressCase(Case):
    """One scene and what is claimed of it.

    Attributes
    ----------
    scene : callable (setting, bench) → scene content
        Raises `NotApplicable` where it makes no sense.
    steps : int
        Nominal number of steps.
    step : float or None
        Δt [s]; None: the base scene's.
    level : Scope
        From which on it is run.
    shape : callable (start positions (V, 3) [m], mean edge length [m]) → positions, optional
        The shape to start from, where it differs from the scene's own.
    own : bool
        It brings its own scene and has nothing to do with the user's.
    swift : bool
        Its iterations and its wall time are judged, too.
    observe : callable (trial) → any, optional
        Called on all ranks at the start and after every step; collected in the record.
    judge : callable (setting, bench, record) → verdicts by name, optional
        What is claimed beside the balances; collective.
    family : str
        Name of the family it belongs to.
    """

    scene: Maker
    steps: int = 20
    step: float | None = None
    level: Scope = Scope.USUAL
    shape: Shaper | None = None
    own: bool = False
    swift: bool = False
    observe: Callable[[Trial], Any] | None = None
    judge: Judge | None = None
    family: str = ""

    def content(self, setting: Setting, bench: Bench) -> Content:
        """The scene, with its time block."""
        if self.own and setting.given:
            raise NotApplicable("has a scene of its own")
        content = self.scene(setting, bench)
        step = self.step if self.step is not None else float(content["time"]["step"])
        content["time"] = {**content["time"], "step": step, "end": self.steps * step}
        return content


@dataclass(frozen=True)
class CaseFamily:
    """Cases that belong together."""

    name: str
    title: str
    cases: tuple[StressCase, ...]


def family(name: str, title: str, *cases: StressCase) -> CaseFamily:
    """The family of these cases."""
    return CaseFamily(name, title, tuple(replace(case, family=name) for case in cases))


CELLS = {Scope.QUICK: 20, Scope.USUAL: 40, Scope.FULL: 40}
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
    scene: Path | None, settings: Sequence[str], level: Scope, *, trust_mesh: bool = False
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
        base = validated(Scene, data, file=None, overridden=overridden)
    else:
        base = load_scene(scene, settings)
    if base.time.static:
        raise InputError(
            "stress tests motions; give --set time.analysis=dynamic --set time.step=0.005",
            file=scene,
            key="time.analysis",
        )
    content: Content = parse_yaml(dump_scene(base), file=None)
    if base.time.adaptive:
        content["time"] |= {"step": STEP}
        content["time"].pop("tolerance")
    for key in ("output", "probes"):
        content.pop(key, None)
    return Setting(content, scene is not None, level, trust_mesh=trust_mesh)


KEPT = ("group", "damping", "warp_degrees", "rest_curvature")
"""Keys of a material that are no stiffness."""


def changed(*changes: Callable[..., Content], **numbers: Any) -> Maker:
    """The scene of a case that is the base scene with these changes; ``numbers`` are for the last of them."""

    def scene(setting: Setting, bench: Bench) -> Content:
        content = setting.content()
        for change in changes[:-1]:
            content = change(content)
        return changes[-1](content, **numbers) if changes else content

    return scene


as_it_is = changed()
"""The base scene."""


def materials(content: Content) -> list[dict[str, Any]]:
    """The material blocks."""
    blocks = content["material"]
    if isinstance(blocks, dict):
        blocks = content["material"] = [blocks]
    return list(blocks)


def scale(
    content: Content, *, stretching: float = 1.0, bending: float = 1.0, density: float = 1.0
) -> Content:
    """Multiply stiffnesses and density of every material, also of library cloths."""
    factors = {"stretching_scale": stretching, "bending_scale": bending, "density_scale": density}
    for block in materials(content):
        for key, factor in factors.items():
            block[key] = block.get(key, 1.0) * factor
    return content


def damp(content: Content, seconds: float) -> Content:
    """Give every material a damping γ [s]."""
    for block in materials(content):
        block["damping"] = seconds
    return content


def anisotropic(content: Content, ratio: float) -> Content:
    """Let c11/c22 be ``ratio``, their geometric mean and the shear stiffness staying, c12 = 0."""
    changed = []
    for block in materials(content):
        shell, _ = resolve_material(Material.model_validate(block))
        mean = (shell.c11 * shell.c22) ** 0.5
        membrane = {"c11": mean * ratio**0.5, "c22": mean / ratio**0.5, "c12": 0.0, "c33": shell.c33}
        kept = {key: block[key] for key in KEPT if key in block}
        bending: dict[str, Any] = {"bending": list(shell.bending)}
        if shell.model == "midedge":
            plate = dict(zip(("d11", "d12", "d22", "d33"), shell.plate, strict=True))
            bending = {"bending": plate, "bending_model": shell.model}
        changed.append({"density": shell.density, "membrane": membrane, **bending, **kept})
    content["material"] = changed
    return content


def by_directors(content: Content) -> Content:
    """Let all that bends bend by directors on its edges."""
    for block in materials(content):
        block["bending_model"] = "midedge"
    return content


def blow(content: Content, speed: float) -> Content:
    """Wind of ``speed`` [m/s], oblique to all axes; density and drag stay where the scene has them."""
    old = content.get("wind") or {}
    along = [0.36 * speed, 0.48 * speed, 0.8 * speed]
    content["wind"] = {"velocity": along, "density": old.get("density") or 1.2, "drag": old.get("drag", 0.0)}
    return content


def weigh(content: Content, factor: float) -> Content:
    """Multiply gravity."""
    if not any(content.get("gravity") or ()):
        raise NotApplicable("has no gravity to be multiplied")
    content["gravity"] = [factor * g for g in content["gravity"]]
    return content


def release(content: Content) -> Content:
    """Take all handles away."""
    content["handles"] = []
    return content


def move(content: Content, keyframes: list[dict[str, Any]]) -> Content:
    """Move all handles alike, for ever, linearly between the keyframes."""
    if not content.get("handles"):
        raise NotApplicable("needs a handle")
    content["motions"] = {**(content.get("motions") or {}), "stress": keyframes}  # obstacles keep theirs
    for handle in content["handles"]:
        handle |= {"motion": "stress", "interpolation": "linear", "from": 0.0}
        for key in ("until", "fade"):
            handle.pop(key, None)
    return content
