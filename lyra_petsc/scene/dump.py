"""The scene as understood, written out with every default, so that it can be read again."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lyra_petsc.scene.block import Block
from lyra_petsc.scene.schema import Scene

if TYPE_CHECKING:
    from ruamel.yaml.nodes import ScalarNode
    from ruamel.yaml.representer import RoundTripRepresenter


def dump_scene(scene: Scene) -> str:
    """YAML of ``scene``, all defaults filled in; `load_scene` makes an equal scene of it.

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
    yaml.dump(_plain(scene), stream)
    return stream.getvalue()


def _float_node(representer: RoundTripRepresenter, value: float) -> ScalarNode:
    # with a point also before an exponent: YAML 1.1 readers take 1e-06 for text
    digits = repr(value)
    if "e" in digits and "." not in digits:
        digits = digits.replace("e", ".0e")
    node: ScalarNode = representer.represent_scalar("tag:yaml.org,2002:float", digits)
    return node


def _plain(value: Any) -> Any:
    from ruamel.yaml.comments import CommentedSeq

    if isinstance(value, Block):
        block = {}
        for name, field in type(value).model_fields.items():
            entry = getattr(value, name)
            absent = entry is None and field.default is None
            if not absent and entry != math.inf:
                block[field.alias or name] = _plain(entry)
        return block
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        sequence = CommentedSeq(_plain(entry) for entry in value)
        if not any(isinstance(entry, dict) for entry in sequence):
            sequence.fa.set_flow_style()
        return sequence
    return str(value) if isinstance(value, Path) else value
