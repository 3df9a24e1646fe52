#!/usr/bin/env python3
"""Makes a mannequin, an obstacle for garments: body.obj at rest, and walk.npz, in which it walks on the spot.

    python scripts/mannequin.py FOLDER [--triangles 20000] [--frames 120] [--fps 30] [--wait 0]

It needs numpy and the extra `view`. The body is the surface at a distance from bones, blended between them;
z is up, it looks along y, and its arms hang away from its sides. Frame 0 is the body at rest, from which
the walk begins smoothly after it has waited. Vertices turn with the bones near them (linear blend skinning,
as in N. Magnenat-Thalmann, R. Laperrière, D. Thalmann, Graphics Interface 1988).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Bone(NamedTuple):
    """A bone from ``start`` to ``end`` [m] with the body's radii [m] there; ``joint`` turns it."""

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radii: tuple[float, float]
    joint: str


class Joint(NamedTuple):
    """A place [m] about which bones turn, and the joint that it turns with."""

    at: tuple[float, float, float]
    parent: str


TRUNK = [
    Bone((-0.06, 0.0, 0.97), (0.06, 0.0, 0.97), (0.12, 0.12), "trunk"),
    Bone((0.0, 0.0, 1.05), (0.0, 0.01, 1.3), (0.115, 0.13), "trunk"),
    Bone((-0.13, 0.0, 1.37), (0.13, 0.0, 1.37), (0.07, 0.07), "trunk"),
    Bone((0.0, 0.0, 1.42), (0.0, 0.01, 1.52), (0.055, 0.055), "trunk"),
    Bone((0.0, 0.02, 1.57), (0.0, 0.02, 1.63), (0.09, 0.095), "trunk"),
]
RIGHT = [
    Bone((0.2, 0.0, 1.36), (0.36, 0.0, 1.13), (0.052, 0.043), "shoulder"),
    Bone((0.36, 0.0, 1.13), (0.48, 0.03, 0.92), (0.042, 0.032), "elbow"),
    Bone((0.48, 0.03, 0.92), (0.51, 0.04, 0.84), (0.034, 0.038), "elbow"),
    Bone((0.1, 0.0, 0.93), (0.115, 0.0, 0.5), (0.088, 0.058), "hip"),
    Bone((0.115, 0.0, 0.5), (0.12, -0.02, 0.09), (0.056, 0.04), "knee"),
    Bone((0.12, -0.02, 0.05), (0.125, 0.14, 0.035), (0.045, 0.035), "knee"),
]
JOINTS = {
    "shoulder": Joint((0.2, 0.0, 1.36), "trunk"),
    "elbow": Joint((0.36, 0.0, 1.13), "shoulder"),
    "hip": Joint((0.1, 0.0, 0.93), "trunk"),
    "knee": Joint((0.115, 0.0, 0.5), "hip"),
}
SIDES = {"right": 1.0, "left": -1.0}

BLEND = 0.035
"""Length [m] over which bones blend into each other, in shape and in motion."""

STRIDE = 1.1
"""Duration [s] of a stride, two steps."""

START = 0.8
"""Duration [s] in which the walk begins."""


def bones() -> list[Bone]:
    """All bones, those of the left side mirrored."""
    of_sides = [
        Bone((side * b.start[0], *b.start[1:]), (side * b.end[0], *b.end[1:]), b.radii, f"{name} {b.joint}")
        for name, side in SIDES.items()
        for b in RIGHT
    ]
    return [*TRUNK, *of_sides]


def distances(points: Array) -> Array:
    """Distance [m] of points (n, 3) from the body around each bone, (n, bones)."""
    columns = []
    for bone in bones():
        start, along = np.array(bone.start), np.subtract(bone.end, bone.start)
        part = np.clip((points - start) @ along / (along @ along), 0.0, 1.0)
        radius = bone.radii[0] + part * (bone.radii[1] - bone.radii[0])
        columns.append(np.linalg.norm(points - start - part[:, None] * along, axis=1) - radius)
    return np.column_stack(columns)


def distance(points: Array) -> Array:
    """Distance [m] of points (n, 3) from the body, nearly, with its bones blended."""
    of_bones = distances(points)
    nearest = of_bones.min(axis=1)
    smooth = np.log(np.exp(-(of_bones - nearest[:, None]) / (0.25 * BLEND)).sum(axis=1))
    return nearest - 0.25 * BLEND * smooth


def surface(spacing: float) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (V, 3) [m] and triangles (F, 3) of the body, from a grid of points this far [m] apart."""
    import pyvista

    low, high = np.array([-0.62, -0.3, -0.05]), np.array([0.62, 0.3, 1.8])
    count = np.ceil((high - low) / spacing).astype(int) + 1
    grid = pyvista.ImageData(dimensions=tuple(count), spacing=(spacing,) * 3, origin=tuple(low))
    contour = grid.contour([0.0], distance(np.asarray(grid.points, dtype=np.float64)))
    return np.asarray(contour.points, np.float64), contour.faces.reshape(-1, 4)[:, 1:].astype(np.int64)


def even(points: Array, triangles: NDArray[np.int64]) -> Array:
    """The vertices moved along the surface until triangles are of nearly equal size."""
    ends = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    count = np.bincount(ends[:, 0], minlength=len(points))[:, None]
    for _ in range(20):
        mean = np.zeros_like(points)
        np.add.at(mean, ends[:, 0], points[ends[:, 1]])
        points = 0.5 * (points + mean / count)
        for _ in range(3):  # back to the surface
            step = 1e-5 * np.eye(3)
            slopes = [distance(points + d) - distance(points - d) for d in step]
            normal = np.column_stack(slopes) / 2e-5
            points = points - (distance(points) / (normal**2).sum(axis=1))[:, None] * normal
    return points


def weights(points: Array) -> tuple[list[str], Array]:
    """Names of the joints, and the part (V, joints) of each in the motion of the vertices."""
    names = list(dict.fromkeys(bone.joint for bone in bones()))
    near = np.exp(-np.maximum(distances(points), 0.0) / (0.3 * BLEND))
    parts = np.zeros((len(points), len(names)))
    for bone, column in zip(bones(), near.T, strict=True):
        at = names.index(bone.joint)
        parts[:, at] = np.maximum(parts[:, at], column)
    return names, parts / parts.sum(axis=1, keepdims=True)


def angles(name: str, time: float) -> float:
    """Angle [rad] by which a joint is turned forward (about -x) while walking."""
    side, _, joint = name.partition(" ")
    phase = 2.0 * np.pi * time / STRIDE + (0.0 if side == "right" else np.pi)
    degrees = {
        "hip": 5.0 + 22.0 * np.sin(phase),
        "knee": -12.0 - 24.0 * max(0.0, np.sin(phase - 0.9 + np.pi / 2.0)) ** 2,
        "shoulder": -18.0 * np.sin(phase),
        "elbow": 12.0 - 8.0 * np.sin(phase),
    }
    begun = min(time / START, 1.0)
    return float(np.radians(degrees[joint]) * begun**2 * (3.0 - 2.0 * begun))


def transforms(time: float) -> dict[str, tuple[Array, Array]]:
    """Rotation (3, 3) and translation (3,) [m] of each joint's bones at a time [s]."""
    placed: dict[str, tuple[Array, Array]] = {"trunk": (np.eye(3), np.zeros(3))}
    for side, sign in SIDES.items():
        for joint, (at, parent) in JOINTS.items():
            angle = angles(f"{side} {joint}", time)
            cosine, sine = np.cos(angle), np.sin(angle)
            turn = np.array([[1.0, 0.0, 0.0], [0.0, cosine, sine], [0.0, -sine, cosine]])
            centre = np.array([sign * at[0], *at[1:]])
            rotation, translation = placed[parent if parent == "trunk" else f"{side} {parent}"]
            placed[f"{side} {joint}"] = rotation @ turn, rotation @ (centre - turn @ centre) + translation
    return placed


def walk(points: Array, frames: int, fps: float) -> tuple[Array, Array]:
    """Times (T,) [s] and positions (T, V, 3) [m] of the walking body."""
    names, parts = weights(points)
    times, positions = np.arange(frames) / fps, np.empty((frames, *points.shape))
    for frame, time in enumerate(times):
        placed = transforms(float(time))
        positions[frame] = sum(
            parts[:, at, None] * (points @ placed[name][0].T + placed[name][1])
            for at, name in enumerate(names)
        )
    return times, positions


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--triangles", type=int, default=20_000)
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--fps", type=float, default=30.0)
    parser.add_argument("--wait", type=float, default=0.0, help="time of frame 0 [s]")
    chosen = parser.parse_args()
    spacing = 0.02
    for _ in range(2):  # the number of triangles goes with the square of the spacing
        points, triangles = surface(spacing)
        spacing *= (len(triangles) / chosen.triangles) ** 0.5
    points, triangles = surface(spacing)
    points = even(points, triangles)
    times, positions = walk(points, chosen.frames, chosen.fps)
    chosen.folder.mkdir(parents=True, exist_ok=True)
    lines = ["v {:.7f} {:.7f} {:.7f}".format(*point) for point in positions[0]]
    lines += ["f {} {} {}".format(*corners) for corners in triangles + 1]
    (chosen.folder / "body.obj").write_text("\n".join(lines) + "\n")
    np.savez(chosen.folder / "walk.npz", time=chosen.wait + times, position=positions.astype(np.float32))
    print(f"{chosen.folder}: body.obj with {len(triangles)} triangles, walk.npz with {len(times)} frames")


if __name__ == "__main__":
    main()
