"""What a .geo script may say: geometry, and nothing that reaches beyond its own folder.

A .geo is a program for gmsh, which would run shell commands and write files for it. A scene is data; so
the script is read before gmsh sees it, word by word as gmsh's own reader does (gmsh 4.8 to 4.13,
``src/parser/Gmsh.l``).
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from lyra_petsc.errors import InputError
from lyra_petsc.meshing.files import read_bytes
from lyra_petsc.scene.values import one_line

_RUNS = "starts other programs"
_WRITES = "writes files"
_READS = "reads what the scene does not name"
_LEAVES = "ends or stops gmsh"

REFUSED: dict[str, str] = {
    **dict.fromkeys(("SystemCall", "System", "NonBlockingSystemCall", "OnelabRun", "OnelabAction"), _RUNS),
    **dict.fromkeys(("ExternalProcess", "CommandLine", "Solver", "SendToServer", "Plugin"), _RUNS),
    **dict.fromkeys(("Save", "Print", "CreateDir"), _WRITES),
    **dict.fromkeys(("ShapeFromFile", "ListFromFile", "GetEnv", "Open"), _READS),
    **dict.fromkeys(("Exit", "Sleep"), _LEAVES),
}
"""Commands, keywords and groups of options that no script needs to describe a surface."""

_INCLUDES: dict[str, tuple[str, ...]] = {"Include": (".geo",)}
_MERGED = (".geo", ".msh", ".step", ".stp", ".brep", ".iges", ".igs", ".stl")
_INCLUDES |= dict.fromkeys(("Merge", "MergeWithBoundingBox"), _MERGED)

_JUMPS = frozenset(("If", "ElseIf", "Else", "EndIf", "For", "EndFor", "Macro", "Function", "Return", "Call"))

LONGEST_STRING = 1000
"""Characters of a text in quotes: from 1023 on gmsh takes the rest for commands."""

_TOKEN = re.compile(
    r"""(?P<comment>//[^\n]*|/\*.*?(?:\*/|\Z))
      | (?P<text>"[^"]*(?:"|\Z)|'[^']*(?:'|\Z))
      | (?P<number>\d+(?:\.\d*)?(?:[eE][-+]?\d+)?|\.\d+(?:[eE][-+]?\d+)?)
      | (?P<word>[A-Za-z_]\w*)
      | (?P<sign>>>|\S)""",
    re.VERBOSE | re.DOTALL | re.ASCII,
)

_SPEECH = frozenset(("System", "Save", "Print", "Open", "Exit", "Sleep", "Solver", "Include", "Merge"))
"""Those that a comment may well use as plain words."""

_ANY = re.compile(rf"\b(?:{'|'.join((*REFUSED, *_INCLUDES, 'Printf'))})\b", re.ASCII)
_GEOMETRY = (
    "Point|Line|Circle|Ellipse|Spline|BSpline|Bezier|Curve|Plane|Ruled|Surface|Volume|Physical|Transfinite|"
    "Recombine|Mesh|Geometry|Field|Extrude|Rotate|Translate|Disk|Rectangle|SetFactory|Delete|If|Else|EndIf|"
    "For|EndFor|Macro|Return|Call"
)
_LIKE_A_COMMAND = re.compile(
    rf"""\w+\s*(?:["'/;=.(\[]|(?!(?:{_GEOMETRY})\b)[A-Za-z_]\w*\s*[;(\[~.:])""", re.VERBOSE | re.ASCII
)
_PRINTS = re.compile(r"Printf\s*\([^;]*\)\s*>")


@dataclass(frozen=True)
class _Token:
    kind: str
    text: str
    line: int
    at: int


@dataclass
class Script:
    """A script that may be given to gmsh.

    Attributes
    ----------
    files : list of Path
        The script and all it includes.
    """

    files: list[Path] = field(default_factory=list)

    @property
    def further(self) -> list[str]:
        """Names of the files beside the script itself."""
        return [path.name for path in self.files[1:]]


def check_script(path: Path) -> Script:
    """Read a script and what it includes; refuse what is no geometry.

    ``Include`` and ``Merge`` may name files in or below the script's folder; those with commands
    (.geo, and the .opt that gmsh reads beside any file) are checked alike.

    Raises
    ------
    InputError
        A command that runs programs, writes or reads other files, with its line; text that gmsh would
        read otherwise than it looks.
    """
    script = Script()
    _check(path, path.resolve().parent, script)
    return script


def _check(path: Path, root: Path, script: Script) -> None:
    script.files.append(path)
    text = read_bytes(path).decode("latin-1")
    if path.suffix.lower() in (".geo", ".opt"):
        if "\0" in text:
            raise InputError("is no text file, hence no gmsh script", file=path)
        for name, line in _included(text, path):
            _follow(name, line, path, root, script)
    options = path.with_name(path.name + ".opt")
    if options.is_file() and options not in script.files:
        _check(options, root, script)


def _follow(name: str, line: int, path: Path, root: Path, script: Script) -> None:
    """Check the file that ``path`` includes by ``name``."""
    # the bytes of the script are the bytes of the file's name
    there = path.parent / os.fsdecode(name.encode("latin-1"))
    try:
        found = there.resolve()
        inside = found.is_relative_to(root)
        exists = inside and found.is_file()
    except (OSError, ValueError, RuntimeError):
        inside = exists = False
    if not inside:
        raise InputError(
            f"line {line}: {one_line(name)[:80]!r} is not in the folder of the script, as what it includes "
            "must be",
            file=path,
        )
    if not exists:
        raise InputError(f"line {line}: includes {one_line(name)[:80]!r}, which does not exist", file=path)
    if all(other.resolve() != found for other in script.files):
        _check(there, root, script)


def _tokens(text: str) -> Iterator[_Token]:
    line, at = 1, 0
    for match in _TOKEN.finditer(text):
        line += text.count("\n", at, match.start())
        at = match.start()
        yield _Token(match.lastgroup or "", match[0], line, at)


def _included(text: str, path: Path) -> Iterator[tuple[str, int]]:
    """Names and lines of the files a script includes, after refusing what it must not say."""
    tokens = list(_tokens(text))
    jumps = any(token.kind == "word" and token.text in _JUMPS for token in tokens)
    code = [token for token in tokens if token.kind != "comment"]
    for token in tokens:
        if token.kind == "text" and len(token.text) > LONGEST_STRING:
            raise InputError(
                f"line {token.line}: a text of {len(token.text)} characters; gmsh reads at most "
                f"{LONGEST_STRING}",
                file=path,
            )
        # gmsh loses count of quotes and comments where it skips or jumps
        if jumps and token.kind in ("text", "comment") and (found := _hidden(token, text)) is not None:
            line = token.line + token.text.count("\n", 0, found.start() - token.at)
            kind = "comment" if token.kind == "comment" else "quoted text"
            raise InputError(
                f"line {line}: '{found[0]}' stands in a {kind}, which gmsh may take for a command where a "
                "script has If, For or Macro; take it out",
                file=path,
            )
    for number, token in enumerate(code):
        if token.kind != "word":
            continue
        if (why := _refusal(token.text)) is not None or _prints(code, number):
            raise InputError(
                f"line {token.line}: '{token.text}' {why or _WRITES}; a mesh script may only describe a mesh",
                file=path,
            )
        if token.text in _INCLUDES:
            yield _name(code, number, path), token.line


def _hidden(token: _Token, text: str) -> re.Match[str] | None:
    """A refused command within quotes or a comment."""
    for found in _ANY.finditer(text, token.at, token.at + len(token.text)):
        if found[0] == "Printf":
            if _PRINTS.match(text, found.start()):
                return found
        elif found[0] not in _SPEECH or _LIKE_A_COMMAND.match(text, found.start()):
            return found
    return None


def _refusal(word: str) -> str | None:
    if word.endswith("FileName") and word != "CurrentFileName":  # options of fields, logs, sessions
        return _READS
    return REFUSED.get(word)


def _prints(code: list[_Token], number: int) -> bool:
    """Whether a ``Printf`` goes to a file: a > outside its brackets."""
    if code[number].text != "Printf":
        return False
    depth = 0
    for token in code[number + 1 :]:
        if token.kind != "sign":
            continue
        depth += (token.text in "([{") - (token.text in ")]}")
        if token.text == ";":
            return False
        if depth <= 0 and token.text in (">", ">>"):
            return True
    return False


def _name(code: list[_Token], number: int, path: Path) -> str:
    """The file that an ``Include`` or ``Merge`` names."""
    command, rest = code[number], code[number + 1 : number + 3]
    if len(rest) < 2 or rest[0].kind != "text" or rest[1].text != ";":
        raise InputError(
            f"line {command.line}: '{command.text}' must be followed by the file's name in quotes", file=path
        )
    name = rest[0].text[1:-1]
    allowed = _INCLUDES[command.text]
    if Path(name).suffix.lower() not in allowed:
        raise InputError(
            f"line {command.line}: '{command.text}' of {one_line(name)[:80]!r}; "
            f"{', '.join(allowed)} are read",
            file=path,
        )
    return name
