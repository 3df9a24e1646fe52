"""Writing of scenes with all defaults, and comparison of a scene with one that was written."""

from __future__ import annotations

import io
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lyra_petsc.errors import InputError
from lyra_petsc.scene.block import Block
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.text import parse_yaml, read_text

if TYPE_CHECKING:
    from ruamel.yaml.nodes import ScalarNode
    from ruamel.yaml.representer import RoundTripRepresenter

ABSENT = "absent"


@dataclass(frozen=True)
class Change:
    """A key of a scene whose value differs from that of another scene.

    Attributes
    ----------
    key : str
        Path of the key, as in ``handles[1].from``.
    old, new : str
        The values on one line; ``absent`` if there is none.
    """

    key: str
    old: str
    new: str

    def __str__(self) -> str:
        return f"{self.key}: {_shortened(self.old)} → {_shortened(self.new)}"


def dump_scene(scene: Scene) -> str:
    """YAML text of ``scene`` with all defaults, from which `load_scene` makes an equal scene.

    Mesh paths are absolute. Keys whose absence means "off" or "to the end" stay absent.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.representer import RoundTripRepresenter

    class Representer(RoundTripRepresenter):
        pass

    Representer.add_representer(float, _float_node)
    yaml = YAML()
    yaml.Representer = Representer
    yaml.width = 1_000_000  # no line is broken
    stream = io.StringIO()
    yaml.dump(_plain_value(scene), stream)
    return stream.getvalue()


def _float_node(representer: RoundTripRepresenter, value: float) -> ScalarNode:
    # with a decimal point: readers of YAML 1.1 take 1e-06 for text
    digits = repr(value)
    if "e" in digits and "." not in digits:
        digits = digits.replace("e", ".0e")
    return representer.represent_scalar("tag:yaml.org,2002:float", digits)


def _plain_value(value: Any) -> Any:
    from ruamel.yaml.comments import CommentedSeq

    if isinstance(value, Block):
        block = {}
        for name, field in type(value).model_fields.items():
            entry = getattr(value, name)
            absent = entry is None and field.default is None
            if not absent and entry != math.inf:
                block[field.alias or name] = _plain_value(entry)
        return block
    if isinstance(value, dict):
        return {key: _plain_value(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        sequence = CommentedSeq(_plain_value(entry) for entry in value)
        if not any(isinstance(entry, dict) for entry in sequence):
            sequence.fa.set_flow_style()
        return sequence
    return str(value) if isinstance(value, Path) else value


def scene_changes(before: Path, scene: Scene) -> list[Change]:
    """The keys in which ``scene`` differs from a scene that `dump_scene` wrote.

    Parameters
    ----------
    before : Path
        The file; its meshes need not exist.
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


def obstacle_motions(scene: Scene) -> dict[str, Any]:
    """``motion``, a list of keyframes as plain values, and ``interpolation`` of each obstacle without frames,
    by name.
    """
    return {
        name: {
            "motion": [_plain_value(keyframe) for keyframe in scene.keyframes(obstacle)],
            "interpolation": obstacle.interpolation,
        }
        for name, obstacle in (scene.obstacles or {}).items()
        if obstacle.mesh is None or obstacle.mesh.frames is None
    }


def _compare(key: str, old: Any, new: Any) -> list[Change]:
    if isinstance(old, dict) and isinstance(new, dict):
        names = [*old, *(name for name in new if name not in old)]
        pairs = [(f"{key}.{name}" if key else str(name), old.get(name), new.get(name)) for name in names]
        return [change for pair in pairs for change in _compare(*pair)]
    if _is_block_list(old) and _is_block_list(new):
        length = max(len(old), len(new))
        old, new = ([*blocks, *[None] * (length - len(blocks))] for blocks in (old, new))
        return [c for i in range(length) for c in _compare(f"{key}[{i}]", old[i], new[i])]
    return [] if old == new else [Change(key, _text(old), _text(new))]


def _is_block_list(value: Any) -> bool:
    return isinstance(value, list) and any(isinstance(entry, dict) for entry in value)


def _text(value: Any) -> str:
    if value is None:
        return ABSENT
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, default=str)


def _shortened(text: str) -> str:
    max_length = 60
    return text if len(text) <= max_length else text[: max_length - 1] + "…"
