"""What a scene says otherwise than the one a run was begun with."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lyra_petsc.errors import InputError
from lyra_petsc.scene.dump import dump_scene
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.text import parse_yaml, read_text

ABSENT = "absent"
LONGEST = 60


@dataclass(frozen=True)
class Change:
    """A key with another value.

    Attributes
    ----------
    key : str
        Dotted, as in ``handles[1].from``.
    old, new : str
        The values in one line; ``absent`` where there is none.
    """

    key: str
    old: str
    new: str

    def __str__(self) -> str:
        return f"{self.key}: {_short(self.old)} → {_short(self.new)}"


def changes(before: Path, scene: Scene) -> list[Change]:
    """The keys in which ``scene`` differs from a scene as understood, in a file.

    Parameters
    ----------
    before : Path
        As `dump_scene` wrote it; the meshes it names need not exist.
    scene : Scene

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    old = parse_yaml(read_text(before), file=before)
    if not isinstance(old, dict):
        raise InputError("is not a scene", file=before)
    new = parse_yaml(dump_scene(scene), file=scene.source)
    return _compare("", old, new)


def _compare(key: str, old: Any, new: Any) -> list[Change]:
    if isinstance(old, dict) and isinstance(new, dict):
        names = [*old, *(name for name in new if name not in old)]
        pairs = [(f"{key}.{name}" if key else str(name), old.get(name), new.get(name)) for name in names]
        return [change for pair in pairs for change in _compare(*pair)]
    if _blocks(old) and _blocks(new):
        length = max(len(old), len(new))
        old, new = ([*blocks, *[None] * (length - len(blocks))] for blocks in (old, new))
        return [c for i in range(length) for c in _compare(f"{key}[{i}]", old[i], new[i])]
    return [] if old == new else [Change(key, _text(old), _text(new))]


def _blocks(value: Any) -> bool:
    return isinstance(value, list) and any(isinstance(entry, dict) for entry in value)


def _text(value: Any) -> str:
    if value is None:
        return ABSENT
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, default=str)


def _short(text: str) -> str:
    return text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"
