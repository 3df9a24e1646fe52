"""Exact solutions by name; one line each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from lyra_petsc.errors import InputError, nearest
from lyra_petsc.experiments.exact import breathing, fall
from lyra_petsc.experiments.exact.body import Body
from lyra_petsc.experiments.exact.motion import Motion


@dataclass(frozen=True)
class Solution:
    """An exact solution.

    Attributes
    ----------
    name : str
    title : str
        In words, for reports.
    obstacles : callable
        What of a scene contradicts its assumptions, in words; empty if it holds.
    motion : callable
        The motion, for a scene without obstacles.
    """

    name: str
    title: str
    obstacles: Callable[[Body], list[str]]
    motion: Callable[[Body], Motion]


SOLUTIONS = {
    solution.name: solution
    for solution in (
        Solution("free-fall", "free fall, x = X + v t + g t²/2", fall.free_fall_obstacles, fall.free_fall),
        Solution(
            "terminal-fall",
            "level sheet falling in still air, v = vt tanh(g t/vt)",
            fall.flat_fall_obstacles,
            fall.flat_fall,
        ),
        Solution(
            "edge-fall",
            "upright sheet falling edge-on in still air, v = vt (1 - exp(-g t/vt))",
            fall.edge_fall_obstacles,
            fall.edge_fall,
        ),
        Solution(
            "breathing-triangle",
            "equilateral triangle oscillating in its plane, Jacobi's dn",
            breathing.obstacles,
            breathing.breathing,
        ),
    )
}


def exact_motion(name: str, body: Body) -> Motion:
    """The exact motion of that name for a scene.

    Raises
    ------
    InputError
        Unknown name, or a scene that violates an assumption; all that is violated is named.
    """
    key = f"--reference exact:{name}"
    if name not in SOLUTIONS:
        raise InputError(f"no exact solution of that name, {nearest(name, SOLUTIONS)}", key=key)
    found = SOLUTIONS[name].obstacles(body)
    if found:
        raise InputError(
            f"does not hold for this scene, which has {', '.join(found)}", file=body.scene.source, key=key
        )
    return SOLUTIONS[name].motion(body)


def matching(body: Body) -> Solution | None:
    """The exact solution that holds for a scene, if one does."""
    return next((solution for solution in SOLUTIONS.values() if not solution.obstacles(body)), None)
