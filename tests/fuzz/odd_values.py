"""Unusual values in YAML, and numbers of all magnitudes."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from typing import Any

from hypothesis import strategies as st


class Raw(str):
    """A piece of YAML that is written unchanged."""


def listed(text: str) -> list[str]:
    """The words of a text."""
    return text.split()


def pieces(text: str) -> list[str]:
    """The parts of a text between bars."""
    return [piece.strip() for piece in text.split("¦")]


NUMBERS = listed("""
0 -0.0 1 -1 2 3 0.5 1e-3 1e3 1e308 -1e308 1.7976931348623157e308 1e309 -1e309 5e-324 2.2e-308 1e-320 1e-160
1e160 1e-30 1e30 1e15 1e-15 .nan .NaN .inf -.inf 2147483647 2147483648 -2147483648 4294967296
9223372036854775807 9223372036854775808 18446744073709551616 0x10 0o17 017 0b11 1_000 1:30:00 190:20:30.15
12e03 +1 +.5 1. 1e 0.1e-4000
""")
NUMBERS += ["1" + "0" * 400, "1" + "0" * 5000]

WORDS = listed(r"""
~ null true false yes no on auto static '' abc gravity "1.0" 'nan' "\0" "a\0b" "\n" "a\nb" "\r\n" "\u202e"
"\ud83d\ude00" "\x07" "\e[31m" ünïcödé 日本語 2001-01-01 2001-12-14t21:59:43.10-05:00 2001-13-45 12:30
../../etc/passwd /etc/passwd /dev/zero / mesh.obj none.geo - ? % @a `a` * *nowhere &anchor
""")
WORDS += pieces(r"""
" " ¦ a: b ¦ - a ¦ &anchor 1 ¦ !!str 1 ¦ !!int 1.5 ¦ !!int abc ¦ !!float abc ¦ !!bool 1 ¦
!!binary aGVsbG8= ¦ !!binary ? ¦ !!null '' ¦ !!timestamp 2001-01-01 ¦ !!timestamp abc ¦ !!omap [a: 1] ¦
!!set {a, b} ¦ !!pairs [a: 1] ¦ !local 1 ¦ !!python/object/apply:os.system ['touch mark'] ¦
!!python/name:os.system '' ¦ !<tag:x> 1 ¦ ! 1
""")
WORDS += ["", "'" + "x" * 3000 + "'", "|\n  a\n  b", ">\n  a\n  b"]

BLOCKS = pieces("""
[] ¦ {} ¦ [[]] ¦ [{}] ¦ {a: 1} ¦ {1: 2} ¦ {[1]: 2} ¦ {? a} ¦ [1, 2] ¦ [1, 2, 3] ¦ [0, 0, 0] ¦ [a, b, c] ¦
[1, [2], 3] ¦ [.nan, 0, 0] ¦ [1e308, 1e308, 1e308] ¦ [1e-320, 0, 0] ¦ [x] ¦ [x, y, z] ¦ [x, x] ¦
[[0, 0, 0], [1, 1, 1]] ¦ {<<: {a: 1}} ¦ {<<: [1]} ¦ {<<: 1} ¦ {a: 1, a: 2} ¦ [&a [1, *a]] ¦
&loop [*loop] ¦ &b {c: *b}
""")
BLOCKS += ["[" + "1, " * 3000 + "1]", "[" * 300 + "]" * 300, "{a: " * 100 + "1" + "}" * 100]


def raw(words: list[str]) -> st.SearchStrategy[Any]:
    """One of the pieces of YAML, to be written unchanged."""
    return st.sampled_from(list(map(Raw, words)))


def anything() -> st.SearchStrategy[Any]:
    """An unusual number, word or block."""
    return raw(NUMBERS) | raw(WORDS) | raw(BLOCKS)


def magnitude() -> st.SearchStrategy[float]:
    """A positive number of any magnitude of a double."""
    return st.floats(-323.0, 308.0).map(lambda power: max(10.0**power, 5e-324))


HUGE = [10**5, 10**6, 10**9, 2**31 - 2, 2**31]


@st.composite
def varied(draw: Any, value: Any) -> Any:
    """A copy of plain values in which some numbers are changed: most a little, a few to any magnitude."""
    out = deepcopy(value)
    for path in draw(st.lists(st.sampled_from(paths_of(out)), max_size=8)):
        inside = entry_at(out, path[:-1])
        old, chance = inside[path[-1]], draw(st.integers(0, 9))
        if isinstance(old, float):
            odd = magnitude() if chance == 0 else st.sampled_from([0.0, -old])
            inside[path[-1]] = draw(odd) if chance < 2 else old * draw(st.floats(0.5, 2.0))
        elif isinstance(old, int) and not isinstance(old, bool):
            inside[path[-1]] = draw(st.sampled_from(HUGE) if chance == 0 else st.integers(0, 4))
    return out


def entry_at(value: Any, path: Sequence[Any]) -> Any:
    """The entry of ``value`` at one of its `paths_of`."""
    for key in path:
        value = value[key]
    return value


def emit(value: Any) -> str:
    """YAML of plain values in flow style; `Raw` pieces are unchanged."""
    if isinstance(value, Raw):
        return str(value)
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {emit(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(emit(entry) for entry in value) + "]"
    if value is None:
        return "~"
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value) if isinstance(value, float) else str(value)


def document(blocks: dict[str, Any]) -> str:
    """Text of a scene file with one key in each line."""
    return "".join(f"{key}: {emit(value)}\n" for key, value in blocks.items())


def paths_of(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths of all entries below ``value``."""
    paths = []
    entries = (
        value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    )
    for key, entry in entries:
        paths += [(*path, key), *paths_of(entry, (*path, key))]
    return paths
