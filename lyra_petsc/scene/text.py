"""Reading of text files, YAML, and JSON with comments; errors name file and line."""

from __future__ import annotations

import io
import json
import math
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lyra_petsc.errors import InputError
from lyra_petsc.scene.values import one_line

if TYPE_CHECKING:
    from ruamel.yaml.nodes import Node


# limit on the bytes of a scene file: enough for lists of some million vertices
def read_text(path: Path, *, largest: float = 32 * 2**20, remedy: str = "") -> str:
    """The text of a file; ``remedy`` is added to the message if it is too large.

    Raises
    ------
    InputError
        As `read_bytes`, or if the file is not UTF-8.
    """
    try:
        return read_bytes(path, largest=largest, remedy=remedy).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"is not UTF-8 text (byte {error.start})", file=path) from None


def read_bytes(path: Path, *, largest: float = math.inf, remedy: str = "") -> bytes:
    """The content of a file.

    Raises
    ------
    InputError
        Missing, a directory, unreadable, larger than ``largest`` bytes, or empty.
    """
    try:
        if not path.is_file():
            kind = "is a directory, not a file" if path.is_dir() else "is not a regular file"
            raise InputError(kind if path.exists() else "no such file", file=path)
        size = path.stat().st_size
        if size > largest:
            message = f"holds {size} bytes; at most {largest} are read"
            raise InputError(f"{message}; {remedy}" if remedy else message, file=path)
        content = path.read_bytes()
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else None
        raise InputError(f"cannot be read: {reason or error}", file=path) from None
    if not content.strip():
        raise InputError("is empty", file=path)
    return content


def parse_yaml(text: str, *, file: object | None, key: str | None = None) -> Any:
    """YAML 1.2 text as plain values; duplicate keys and anchors that expand without bound are refused."""
    # limit on the entries of a scene whose YAML anchors are expanded
    max_entries = 2_000_000
    from ruamel.yaml import YAML
    from ruamel.yaml.error import MarkedYAMLError, YAMLError

    yaml = YAML(typ="safe", pure=True)
    try:
        # the nodes are counted before values are made: a block with an anchor is one node
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an anchor may be redefined
            node = yaml.compose(io.StringIO(text))
        if (entries := _count_entries(node, {})) > max_entries:
            grown = f"holds more than {max_entries} entries once its anchors are expanded"
            raise InputError("refers to itself" if entries == math.inf else grown, file=file, key=key)
        for mistake in _mistaken_keys(node, set()):
            raise InputError(mistake, file=file, key=key)
        return None if node is None else yaml.constructor.construct_document(node)
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        message = str(error.problem or error.context)
        if mark:
            message = _mistake_near(text.splitlines(), mark.line, mark.column, message)
        raise InputError(one_line(message), file=file, key=key) from None
    except RecursionError:
        raise InputError("is nested too deeply", file=file, key=key) from None
    except (YAMLError, ValueError, TypeError, AttributeError, ArithmeticError, LookupError) as error:
        # ruamel raises these for some invalid scalars (a 13th month, tags on the wrong kind of node)
        raise InputError(one_line(f"is not YAML: {error}"), file=file, key=key) from None


def _count_entries(node: Node | None, known: dict[int, float]) -> float:
    """Number of entries below a node, with anchors expanded; inf for a node that contains itself.

    ``known`` has the counts by identity of the nodes.
    """
    if node is None or isinstance(node.value, str):
        return 1.0
    if id(node) not in known:
        known[id(node)] = math.inf  # found again below itself
        entries = [part for entry in node.value for part in (entry if isinstance(entry, tuple) else (entry,))]
        known[id(node)] = 1.0 + sum(_count_entries(entry, known) for entry in entries)
    return known[id(node)]


_WITHOUT_COLON = re.compile(r"\s*(?:- +)*(\w[\w-]*)(?:[ \t]+[^\s:#].*|:[^\s:].*|[ \t]*)")
"""A key that runs into its value, as in ``end 1`` or ``end:1``, or that stands alone."""

_NO_COLON = "line {}: {!r} needs a colon and a blank after it"


def _mistake_near(lines: list[str], at: int, column: int, message: str) -> str:
    """What is wrong near the place, counted from 0, at which YAML cannot be read with this message."""
    place = f"line {at + 1}, column {column + 1}: "
    if r"'\t'" in message:
        return f"{place}a tab, which YAML does not take here; use blanks"
    if "mapping values" in message or "expected ':'" in message or "<block end>" in message:
        before = lines[at][:column] if at < len(lines) else ""
        # the last line with content before the place, too, unless this one has a colon
        for number in range(at, -1 if ": " not in before else at - 1, -1):
            content = lines[number] if number < len(lines) else ""
            if word := _WITHOUT_COLON.fullmatch(content):
                return _NO_COLON.format(number + 1, word[1])
            if number < at and content.strip():
                break
        if ": " in before and "mapping" in message:
            return f"{place}a second colon in one value; put text with colons in quotes"
        if "mapping" in message:
            return f"{place}indented differently from the keys beside it"
    return place + message


def _mistaken_keys(node: Node | None, seen: set[int]) -> Iterator[str]:
    """What is wrong with each key below a node that is given twice, or runs into its value in braces."""
    if node is None or isinstance(node.value, str) or id(node) in seen:
        return
    seen.add(id(node))
    lines: dict[tuple[str, str], int] = {}
    for entry in node.value:
        parts = entry if isinstance(entry, tuple) else (entry,)
        name = parts[0].value
        if len(parts) == 2 and isinstance(name, str):
            line = parts[0].start_mark.line + 1
            if first := lines.get((parts[0].tag, name)):
                yield f"line {line}: {name!r} is given twice, first in line {first}; keep one of them"
            lines[parts[0].tag, name] = line
            absent = parts[1].start_mark.index == parts[0].end_mark.index  # no colon in between
            if absent and (word := _WITHOUT_COLON.fullmatch(name)) and word[1] != name:
                yield _NO_COLON.format(line, word[1])
        for part in parts:
            yield from _mistaken_keys(part, seen)


def parse_json(text: str, *, file: object | None) -> Any:
    """JSON with // and /* */ comments and trailing commas; duplicate keys are refused."""

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        block = dict(pairs)
        if len(block) < len(pairs):
            names = [name for name, _ in pairs]
            twice = next(name for name in names if names.count(name) > 1)
            raise InputError("given twice", file=file, key=one_line(twice))
        return block

    def constant(word: str) -> float:
        raise InputError(f"holds {word}, which is no number", file=file)

    def finite(digits: str) -> float:
        value = float(digits)
        return value if math.isfinite(value) else constant(digits)

    try:
        return json.loads(
            _plain_json(text), object_pairs_hook=unique, parse_constant=constant, parse_float=finite
        )
    except json.JSONDecodeError as error:
        raise InputError(
            f"line {error.lineno}, column {error.colno}: is not JSON: {error.msg}", file=file
        ) from None
    except RecursionError:
        raise InputError("is nested too deeply", file=file) from None
    except ValueError as error:
        raise InputError(one_line(f"is not JSON: {error}"), file=file) from None


_JSON_PARTS = re.compile(
    r"""(?P<text>"[^"\\]*(?:\\.[^"\\]*)*"?)
    | (?P<comment>//[^\n]*|/\*.*?(?:\*/|\Z))
    | ,(?=(?:\s|//[^\n]*(?:\n|\Z)|/\*(?:(?!\*/).)*\*/)*[]}])""",
    re.VERBOSE | re.DOTALL,
)


def _plain_json(text: str) -> str:
    """``text`` with blanks for comments and trailing commas, which keep line and column in errors right."""
    return _JSON_PARTS.sub(lambda part: part["text"] or re.sub(r"[^\n]", " ", part[0]), text)
