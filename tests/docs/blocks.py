"""Code blocks of the documentation, with the instructions to their tests in the comments before them.

A comment ``<!-- test: WORDS -->`` on the line before a block, invisible to readers, has words among

``exit=N``
    the last command ends with this exit code;
``by=PATH``
    is not run, as it takes too long: the test at PATH does the same with other sizes;
``not here: REASON``
    cannot run here at all (a cluster, another installation); its syntax is checked.

A block with ``title="NAME"`` in its first line is a file, which is written before later commands run.
"""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]

_INLINE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
_STARTS = re.compile(
    r"(?:lyra-petsc|python -m lyra_petsc|bash scripts/lyra\.sh|bash scripts/(run)\.sh) +([^;|>#]*)"
)
_FENCE = re.compile(r"^(?P<indent> *)```(?P<language>\w*)(?P<rest>[^\n`]*)$")
_TITLE = re.compile(r'title="([^"]+)"')
_SAID = re.compile(r"^ *<!-- test: (.*) -->$")


@dataclass(frozen=True)
class Block:
    """One code block.

    Attributes
    ----------
    page : Path
    line : int
        Line of its first fence, from 1.
    language : str
        Empty for output of a program.
    text : str
    title : str
        Name of its file, or empty.
    said : str
        Text of its comment.
    """

    page: Path
    line: int
    language: str
    text: str
    title: str
    said: str

    @property
    def place(self) -> str:
        """Page and line of the block."""
        return f"{self.page.relative_to(ROOT)}:{self.line}"

    @property
    def runs(self) -> bool:
        """Whether the tests of the documentation run the block as a program or as commands."""
        elsewhere = self.said.startswith(("not here: ", "by="))
        return self.language in ("sh", "python") and not self.title and not elsewhere

    @property
    def exit_code(self) -> int:
        """Exit code of its last command."""
        found = re.search(r"exit=(\d+)", self.said)
        return int(found[1]) if found else 0


def blocks_of(page: Path) -> list[Block]:
    """The code blocks of a page in order."""
    found: list[Block] = []
    lines = page.read_text(encoding="utf-8").splitlines()
    number = 0
    while number < len(lines):
        opening = _FENCE.match(lines[number])
        if opening is None:
            number += 1
            continue
        end = next(i for i in range(number + 1, len(lines)) if lines[i].strip() == "```")
        said = _SAID.match(lines[number - 1]) if number else None
        title = _TITLE.search(opening["rest"])
        indent = len(opening["indent"])
        found.append(
            Block(
                page,
                number + 1,
                opening["language"],
                "\n".join(line[indent:] for line in lines[number + 1 : end]) + "\n",
                title[1] if title else "",
                said[1] if said else "",
            )
        )
        number = end + 1
    return found


def commands_of(page: Path) -> list[tuple[str, list[str]]]:
    """Each call of the program on a page, in code blocks or in the text: its beginning, and its words."""
    texts = [block.text.replace("\\\n", " ") for block in blocks_of(page) if block.language == "sh"]
    texts += _INLINE.findall(page.read_text(encoding="utf-8"))
    found = []
    for text in texts:
        for line in text.splitlines():
            for match in _STARTS.finditer(line):
                words = shlex.split(match[2])
                found.append((match[0], ["run", *words] if match[1] else words))
    return found
