"""What cases do to a scene, in the keys of a scene file; every function changes it in place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from lyra_petsc.experiments.bench import Bench
from lyra_petsc.experiments.stress.case import Content, Maker, NotHere, Setting
from lyra_petsc.scene.materials.library import resolve
from lyra_petsc.scene.schema import Material

KEPT = ("group", "damping", "warp_degrees", "rest_curvature")
"""Keys of a material that are no stiffness."""


def changed(change: Callable[..., Content], **numbers: float) -> Maker:
    """The scene of a case that is the base scene with one of the changes below."""

    def scene(setting: Setting, bench: Bench) -> Content:
        return change(setting.content(), **numbers)

    return scene


def as_it_is(setting: Setting, bench: Bench) -> Content:
    """The base scene."""
    return setting.content()


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
        shell, _ = resolve(Material.model_validate(block))
        mean = (shell.c11 * shell.c22) ** 0.5
        membrane = {"c11": mean * ratio**0.5, "c22": mean / ratio**0.5, "c12": 0.0, "c33": shell.c33}
        kept = {key: block[key] for key in KEPT if key in block}
        bending = list(shell.bending)
        changed.append({"density": shell.density, "membrane": membrane, "bending": bending, **kept})
    content["material"] = changed
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
        raise NotHere("has no gravity to be multiplied")
    content["gravity"] = [factor * g for g in content["gravity"]]
    return content


def release(content: Content) -> Content:
    """Take all handles away."""
    content["handles"] = []
    content.pop("motions", None)
    return content


def move(content: Content, keyframes: list[dict[str, Any]]) -> Content:
    """Move all handles alike, for ever, linearly between the keyframes."""
    if not content.get("handles"):
        raise NotHere("needs a handle")
    content["motions"] = {"stress": keyframes}
    for handle in content["handles"]:
        handle |= {"motion": "stress", "interpolation": "linear", "from": 0.0}
        for key in ("until", "fade"):
            handle.pop(key, None)
    return content
