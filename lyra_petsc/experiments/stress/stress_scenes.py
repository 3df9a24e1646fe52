"""Cases of ``stress``: extreme variants of the user's scene or of a hanging square of cotton.

Functions that change a scene modify the content of a scene file in place.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
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
from lyra_petsc.scene.material_block import Material
from lyra_petsc.scene.materials.library import resolve_material
from lyra_petsc.scene.messages import validated
from lyra_petsc.scene.overrides import apply_overrides
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.text import parse_yaml

if TYPE_CHECKING:
    from lyra_petsc.experiments.stress.verdicts import RunRecord

Content = dict[str, Any]


class Scope(IntEnum):
    """How many cases are run; each level includes the ones before."""

    QUICK = 0
    USUAL = 1
    FULL = 2


@dataclass(frozen=True)
class Setting:
    """The base scene and options of one call of ``stress``.

    Attributes
    ----------
    base : dict
        The base scene, which cases modify, as the content of a scene file.
    of_user : bool
        Whether the base scene is the user's; otherwise it is `hanging_sheet`.
    level : Scope
    size : float
        Diagonal of the bounding box of the rest shape [m].
    trust_mesh : bool
        ``--trust-mesh``.
    """

    base: Content
    of_user: bool
    level: Scope
    size: float = math.sqrt(2.0)
    trust_mesh: bool = False

    def content(self) -> Content:
        """A copy of the base scene that may be modified."""
        return copy.deepcopy(self.base)

    def bench(self, comm: MPI.Comm, watch: Callable[[], None] | None) -> Bench:
        """A test bench on which scenes run with their own solver, as a user's do."""
        return Bench(comm, watch, direct=False, trust_mesh=self.trust_mesh)

    @property
    def step(self) -> float:
        """The base scene's Δt [s]."""
        return float(self.base["time"]["step"])


class NotApplicable(Exception):
    """Raised by a case that does not apply to the base scene; the message says why."""


Maker = Callable[[Setting, Bench], Content]
Shaper = Callable[[Array, float], Array]
Judge = Callable[[Setting, Bench, "RunRecord"], Mapping[str, Verdict]]


@dataclass(frozen=True)
class StressCase(Case):
    """One scene and the claims about its simulation.

    Attributes
    ----------
    scene : callable (setting, bench) → scene content
        Raises `NotApplicable` if it does not apply to the base scene.
    steps : int
        Nominal number of steps.
    step : float or None
        Δt [s]; None: that of the base scene.
    level : Scope
        Lowest level at which the case is run.
    shape : callable (start positions (V, 3) [m], mean edge length [m]) → positions, optional
        The start shape, if it differs from that of the scene.
    own_scene : bool
        The case has a scene of its own, independent of the user's.
    is_timed : bool
        Iterations and time per step are judged as well.
    observe : callable (trial) → any, optional
        Called on all ranks at the start and after every step; the record collects its results.
    judge : callable (setting, bench, record) → verdicts by name, optional
        Verdicts in addition to those on the balances; collective.
    family : str
        Name of its family.
    """

    scene: Maker
    steps: int = 20
    step: float | None = None
    level: Scope = Scope.USUAL
    shape: Shaper | None = None
    own_scene: bool = False
    is_timed: bool = False
    observe: Callable[[Trial], Any] | None = None
    judge: Judge | None = None
    family: str = ""

    def content(self, setting: Setting, bench: Bench) -> Content:
        """The content of the scene, with the time step and end of the case."""
        if self.own_scene and setting.of_user:
            raise NotApplicable("has a scene of its own")
        content = self.scene(setting, bench)
        step = self.step if self.step is not None else float(content["time"]["step"])
        content["time"] = {**content["time"], "step": step, "end": self.steps * step}
        return content


@dataclass(frozen=True)
class CaseFamily:
    """Related cases that are selected by one name."""

    name: str
    title: str
    cases: tuple[StressCase, ...]


CELLS = {Scope.QUICK: 20, Scope.USUAL: 40, Scope.FULL: 40}
"""Cells along a side of the sheet."""

STEP = 0.005
"""Δt [s]; also replaces the adaptive steps of a given scene."""


def hanging_sheet(cells: int) -> Content:
    """The default base scene: a square metre of cotton hung by two corners."""
    stiffness = 120.0  # N/m
    membrane = {"c11": stiffness, "c22": stiffness, "c12": stiffness / 3.0, "c33": 0.25 * stiffness}
    return {
        "title": "A square of cotton hung by two corners",
        "mesh": {"grid": {"width": 1.0, "height": 1.0, "nx": cells, "ny": cells, "pattern": "alternating"}},
        "material": {"density": 0.15, "membrane": membrane, "bending": 1e-5, "damping": 0.005},
        "gravity": [0.0, 0.0, -9.81],
        "handles": [{"nodes": [0, cells]}],
        "time": {"end": 20 * STEP, "step": STEP},
    }


def setting_of(
    scene: Path | None, settings: Sequence[str], level: Scope, *, trust_mesh: bool = False
) -> Setting:
    """Read or make the base scene. On one rank.

    Raises
    ------
    InputError
        For a scene that cannot be used, or a static one.
    """
    if scene is None:
        data: dict[str, Any] = hanging_sheet(CELLS[level])
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
"""Keys of a material block that `anisotropic` keeps."""


def changed_base(changes: Sequence[Callable[[Content], Content]]) -> Maker:
    """The scene function of a case: the base scene with these changes, one after another."""

    def scene(setting: Setting, bench: Bench) -> Content:
        content = setting.content()
        for change in changes:
            content = change(content)
        return content

    return scene


base_scene = changed_base(())
"""The base scene without changes."""


def materials(content: Content) -> list[dict[str, Any]]:
    """The material blocks of a scene, which becomes a list if it was a single block."""
    blocks = content["material"]
    if isinstance(blocks, dict):
        blocks = content["material"] = [blocks]
    return list(blocks)


def scale(
    content: Content, *, stretching: float = 1.0, bending: float = 1.0, density: float = 1.0
) -> Content:
    """Multiply the stiffnesses and the density of every material, including cloths of the library."""
    factors = {"stretching_scale": stretching, "bending_scale": bending, "density_scale": density}
    for block in materials(content):
        for key, factor in factors.items():
            block[key] = block.get(key, 1.0) * factor
    return content


def set_material(content: Content, **values: Any) -> Content:
    """Set keys of every material."""
    for block in materials(content):
        block |= values
    return content


def anisotropic(content: Content, ratio: float) -> Content:
    """Set c11/c22 to ``ratio`` and c12 to 0; the geometric mean of c11 and c22, and c33, stay."""
    blocks = []
    for block in materials(content):
        shell, _ = resolve_material(Material.model_validate(block))
        mean = (shell.c11 * shell.c22) ** 0.5
        membrane = {"c11": mean * ratio**0.5, "c22": mean / ratio**0.5, "c12": 0.0, "c33": shell.c33}
        kept = {key: block[key] for key in KEPT if key in block}
        bending: dict[str, Any] = {"bending": list(shell.bending)}
        if shell.model == "midedge":
            plate = dict(zip(("d11", "d12", "d22", "d33"), shell.plate, strict=True))
            bending = {"bending": plate, "bending_model": shell.model}
        blocks.append({"density": shell.density, "membrane": membrane, **bending, **kept})
    content["material"] = blocks
    return content


def set_wind(content: Content, speed: float) -> Content:
    """Set a wind of ``speed`` [m/s], oblique to all axes; the scene's air density and drag stay."""
    old = content.get("wind") or {}
    along = [0.36 * speed, 0.48 * speed, 0.8 * speed]
    content["wind"] = {"velocity": along, "density": old.get("density") or 1.2, "drag": old.get("drag", 0.0)}
    return content


def scale_gravity(content: Content, factor: float) -> Content:
    """Multiply gravity by a factor."""
    if not any(content.get("gravity") or ()):
        raise NotApplicable("has no gravity to be multiplied")
    content["gravity"] = [factor * g for g in content["gravity"]]
    return content


def remove_handles(content: Content) -> Content:
    """Remove all handles."""
    content["handles"] = []
    return content


def move_handles(content: Content, keyframes: list[dict[str, Any]]) -> Content:
    """Give all handles the same motion without end, linear between the keyframes."""
    if not content.get("handles"):
        raise NotApplicable("needs a handle")
    content["motions"] = {**(content.get("motions") or {}), "stress": keyframes}  # keep those of obstacles
    for handle in content["handles"]:
        handle |= {"motion": "stress", "interpolation": "linear", "from": 0.0}
        for key in ("until", "fade"):
            handle.pop(key, None)
    return content
