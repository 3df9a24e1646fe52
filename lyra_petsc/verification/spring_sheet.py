"""A sheet on springs that all its vertices feel alike: it moves rigidly, as one linear oscillator."""

from __future__ import annotations

from typing import Any

OMEGA = 5.0
"""rad/s"""

DENSITY = 0.3
"""kg/m²"""


def sprung_sheet(time: dict[str, Any]) -> dict[str, Any]:
    """The scene: one cell of two triangles, set off at 1 m/s along z from where its springs are slack.

    A third of a triangle's mass is on each of its corners, and so is a third of its share of stiffness.
    """
    third = DENSITY * 0.5 / 3.0 * OMEGA**2
    return {
        "mesh": {"grid": {"width": 1.0, "height": 1.0, "nx": 1, "ny": 1}},
        "material": {"density": DENSITY, "membrane": {"c11": 50, "c22": 50, "c12": 0, "c33": 20}},
        "handles": [
            {"nodes": [0, 3], "stiffness": 2.0 * third},
            {"nodes": [1, 2], "stiffness": third},
        ],
        "initial": {"velocity": [0, 0, 1]},
        "time": time,
    }
