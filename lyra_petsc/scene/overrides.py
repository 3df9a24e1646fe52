"""Changes of single values of a scene before it is checked: ``--set key.path=value``, or from Python."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lyra_petsc.errors import InputError
from lyra_petsc.scene.messages import dotted
from lyra_petsc.scene.text import parse_yaml
from lyra_petsc.scene.values import cut, one_line

# keys at which a single block is accepted instead of a list
ONE_OR_MANY = ("mesh", "material")

_PART = re.compile(r"([^.\[\]\s]+)((?:\[\d+\])*)")


def apply_overrides(data: dict[str, Any], overrides: Sequence[str]) -> list[str]:
    """Change ``data`` in place by each ``key.path=value``; the value is YAML.

    List entries are named ``handles[0].until`` or ``handles.0.until``; the index after the last
    appends an entry. Missing blocks of the path are created. An empty value removes the key.

    Returns
    -------
    list of str
        The keys that were set, as messages write them.

    Raises
    ------
    InputError
        No ``=``, a malformed path, a value that is no YAML, or a path through a single value.
    """
    return [_apply_override(data, text) for text in overrides]


def apply_changes(data: dict[str, Any], changes: Mapping[str, Any]) -> None:
    """Change ``data`` in place as `apply_overrides` does, but with Python values; None removes a key."""
    for path, value in changes.items():
        _set_key(data, str(path), plain(value), one_line(cut(str(path))))


def plain(value: Any) -> Any:
    """A copy of types that a scene file can contain: lists for tuples and arrays, text for paths.

    Blocks that YAML anchors share are copied, so that each can be changed by itself.
    """
    if isinstance(value, Mapping):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    if hasattr(value, "tolist"):
        return value.tolist()
    return str(value) if isinstance(value, Path) else value


def _apply_override(data: dict[str, Any], text: str) -> str:
    path_text, equals, value_text = text.partition("=")
    option = one_line(f"--set {cut(text)}")
    if not equals:
        raise InputError("must read key.path=value", key=option)
    return _set_key(data, path_text.strip(), parse_yaml(value_text, file=None, key=option), option)


def _set_key(data: dict[str, Any], path: str, value: Any, option: str) -> str:
    parts = _split_path(path, option)
    if parts[0] in ("mesh", "obstacles"):
        value = _absolute_files(value, parts[-1])
    first = parts[0]
    single = first in ONE_OR_MANY and isinstance(data.get(first), dict) and len(parts) > 1
    if single:
        data[first] = [data[first]]
    if first in ONE_OR_MANY and len(parts) > 1 and not parts[1].isdecimal():
        entries = data.get(first)
        if isinstance(entries, list) and len(entries) == 1:
            parts.insert(1, "0")
    target: Any = data
    walked: list[str | int] = []
    for depth, part in enumerate(parts):
        target = _descend(target, part, walked, value, rest=parts[depth + 1 :], option=option)
    if single and len(data[first]) == 1:
        # a single block again, as in the file, so that messages name the keys as written there
        data[first] = data[first][0]
    return dotted(walked, data)


def _split_path(path: str, option: str) -> list[str]:
    parts: list[str] = []
    for piece in path.split("."):
        match = _PART.fullmatch(piece)
        if match is None:
            raise InputError("must read key.path=value, as in handles[0].until=2", key=option)
        parts.append(match[1])
        parts += re.findall(r"\d+", match[2])
    return parts


def _descend(
    target: Any,
    part: str,
    walked: list[str | int],
    value: Any,
    *,
    rest: list[str],
    option: str,
) -> Any:
    """Descend by one part of the path, which is added to ``walked``; at the last part set ``value``."""
    if isinstance(target, list):
        # len(part): Python refuses to convert numbers of thousands of digits
        if not part.isdecimal() or len(part) > 9 or int(part) > len(target):
            many = f"[0] to [{len(target)}]" if target else "[0]"
            raise InputError(f"{cut(dotted(walked))} is a list; give an index, {many}", key=option)
        index: Any = int(part)
        if index == len(target):
            target.append(None)
    elif isinstance(target, dict):
        index = part
        if not rest and value is None and index in target:  # unknown keys are kept, to be refused
            walked.append(index)
            return target.pop(index)
        target.setdefault(index)
    else:
        raise InputError(f"{cut(dotted(walked))} holds a single value, no keys", key=option)
    walked.append(index)
    if not rest:
        target[index] = value
    elif target[index] is None:
        target[index] = [] if rest[0].isdecimal() else {}
    return target[index]


def _absolute_files(value: Any, key: str) -> Any:
    """Make mesh paths of the command line absolute if they exist relative to the working directory."""
    if isinstance(value, dict):
        return {name: _absolute_files(entry, str(name)) for name, entry in value.items()}
    if isinstance(value, list):
        return [_absolute_files(entry, "") for entry in value]
    if key == "file" and isinstance(value, str) and "\0" not in value and Path(value).is_file():
        return str(Path(value).absolute())
    return value
