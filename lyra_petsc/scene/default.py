"""Where the scenes that come with the program are."""

from __future__ import annotations

from pathlib import Path


def default_scene() -> Path:
    """The scene of a run without one: in the wheel beside the package's modules, else in the checkout."""
    package = Path(__file__).resolve().parent.parent
    inside = package / "configs" / "flag.yaml"
    return inside if inside.exists() else package.parent / "configs" / "flag.yaml"
