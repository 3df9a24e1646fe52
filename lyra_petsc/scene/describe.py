"""What the docstrings of the scene's blocks say of their keys, for the JSON Schema and the reference."""

from __future__ import annotations

import inspect
import re
from dataclasses import dataclass

_ENTRY = re.compile(r"(?P<names>\w+(?:, \w+)*)(?: : (?P<kind>.*))?")
_UNIT = re.compile(r"\[([^\]]*)\]")


@dataclass(frozen=True)
class Said:
    """One entry of a docstring's list of attributes.

    Attributes
    ----------
    kind : str
        Type and shape, with the unit in brackets.
    text : str
    """

    kind: str
    text: str

    @property
    def unit(self) -> str:
        """The unit, empty where there is none."""
        found = _UNIT.search(self.kind)
        return found[1] if found else ""

    @property
    def sentence(self) -> str:
        """The text with the unit behind it."""
        return " ".join(part for part in (self.text, f"[{self.unit}]" if self.unit else "") if part)


def summary(block: type) -> str:
    """The first paragraph of a class's docstring, on one line."""
    return " ".join((inspect.getdoc(block) or "").split("\n\n")[0].split())


def attributes(block: type) -> dict[str, Said]:
    """The entries under ``Attributes`` of a class and those it derives from, by name."""
    found: dict[str, Said] = {}
    for parent in reversed(block.__mro__):
        found |= _listed(inspect.cleandoc(parent.__dict__.get("__doc__") or ""))
    return found


def _listed(doc: str) -> dict[str, Said]:
    _, _, section = doc.partition("Attributes\n----------\n")
    found: dict[str, Said] = {}
    names: list[str] = []
    for line in section.splitlines():
        if line.startswith(" "):
            for name in names:
                text = f"{found[name].text} {line.strip()}".strip()
                found[name] = Said(found[name].kind, text)
        elif entry := _ENTRY.fullmatch(line):
            # an entry without a type refers to another docstring
            names = entry["names"].split(", ") if entry["kind"] else []
            found |= {name: Said(entry["kind"], "") for name in names}
        else:
            names = []
    return found
