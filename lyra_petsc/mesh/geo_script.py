"""What a gmsh script (.geo) may say: a list of statements that describe geometry and mesh size.

A .geo is a program for gmsh, which would run shell commands and write files for it. A scene is data; so
each file that gmsh is to see is recognised by its content, and scripts are read before gmsh does, word by
word as its own reader splits them (gmsh 4.8 to 4.15, ``src/parser/Gmsh.l``). gmsh then gets what was read,
not the files: copies without comments, in a folder of their own, where nothing else stands.

gmsh's reader jumps and skips (If, For, Macro) by characters and lines, not by words, and may go on anywhere.
So no word is allowed anywhere that is not on the lists, and no quoted text may look like the end of a jump.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from lyra_petsc.errors import InputError
from lyra_petsc.mesh.geo_words import (
    COLOUR,
    JUMPS,
    NUMBERED,
    OPERANDS,
    OPTIONS,
    REFUSED,
    RESERVED,
    STATEMENTS,
)
from lyra_petsc.scene.text import read_bytes
from lyra_petsc.scene.values import one_line

LONGEST_STRING = 900
"""Characters of a text in quotes: from 1023 on gmsh takes the rest for commands, and its messages that quote
one are of 1024."""

LONGEST_WORD = 200
"""Characters of a name, which messages of gmsh may quote several times."""

LONGEST_FORMAT = 120
"""Characters of a text with places for numbers: gmsh writes each part of it into 256."""

LONGEST_LINE = 4000
"""Characters of a line in a script that jumps: gmsh returns to the middle of those above 8192."""

REMEDY = "a mesh script may only describe geometry and mesh size (--trust-mesh for one that you trust)"

_TOKEN = re.compile(
    r"""(?P<comment>//[^\n]*|/\*.*?(?:\*/|\Z))
      | (?P<text>"[^"]*(?:"|\Z)|'[^']*(?:'|\Z))
      | (?P<number>\d+(?:\.\d*)?(?:[eE][-+]?\d+)?|\.\d+(?:[eE][-+]?\d+)?)
      | (?P<word>[A-Za-z_]\w*)
      | (?P<sign>>>|<<|==|!=|<=|>=|\+=|-=|\*=|/=|\+\+|--|&&|\|\||::|\S)""",
    re.VERBOSE | re.DOTALL | re.ASCII,
)
_SIGNS = frozenset("=+-*/%^!?:;,.<>|&(){}[]~#")
_SIGNS |= {">>", "<<", "==", "!=", "<=", ">=", "+=", "-=", "*=", "/=", "++", "--", "&&", "||", "::"}
_ASSIGNS = frozenset(("=", "+=", "-=", "*=", "/=", "++", "--"))
_CLOSING = {"(": ")", "[": "]", "{": "}"}
_UNPRINTED = re.compile(r"[\x00-\x08\x0b\x0e-\x1f\x7f]")
_JUMP_IN_TEXT = re.compile(rf"\b(?:{'|'.join(sorted(JUMPS))})\b", re.ASCII)
_JUMP_IN_WORD = re.compile(r"(?<![A-Za-z_])(?:EndIf|EndFor|ElseIf|Else|Return)(?![A-Za-z_])")
_FORMATTING = frozenset(("Printf", "Sprintf", "Error", "Warning", "SetFactory"))
"""What gmsh takes for a format of the C library (of SetFactory it quotes it), whatever stands in it."""
_NUMBER_FORMAT = re.compile(r"%[-+ 0]?\d?\d?(?:\.\d\d?)?[efgEFG]")
_BEFORE_STATEMENT = frozenset((";", "}", "Else", "EndIf", "EndFor", "Return"))

_DATA_MARKS: dict[tuple[str, ...], re.Pattern[bytes]] = {
    (".msh", ".MSH"): re.compile(rb"\$MeshFormat[ \t]*\r?\n"),
    (".step", ".STEP", ".stp", ".STP"): re.compile(rb"\s*ISO-10303-21;"),
    (".iges", ".IGES", ".igs", ".IGS"): re.compile(rb"[^\n]{72}[SCB] *\d+ *\r?\n"),
    (".brep", ".brp", ".BRP"): re.compile(
        rb"\s*(?:DBRep_DrawableShape|CASCADE Topology V|Open CASCADE Topology V)"
    ),
    (".stl", ".STL"): re.compile(rb"\s*solid\b"),
}
"""How files of other programs begin, by the endings for which gmsh's own reader asks."""

_MERGED = (".geo", ".pos", ".msh", ".step", ".stp", ".brep", ".brp", ".iges", ".igs", ".stl")
_INCLUDES = {"Include": (".geo",), "Merge": _MERGED, "MergeWithBoundingBox": _MERGED}


class _Token(NamedTuple):
    kind: str
    text: str
    line: int


@dataclass
class _Script:
    path: Path
    tokens: list[_Token]
    names: set[str] = field(default_factory=set)
    partners: dict[int, int] = field(default_factory=dict)
    """Numbers of the brackets that open and close the same, of both kinds."""

    def __post_init__(self) -> None:
        opened: list[int] = []
        for number, token in enumerate(self.tokens):
            if token.kind == "sign" and token.text in _CLOSING:
                opened.append(number)
            elif token.kind == "sign" and token.text in _CLOSING.values() and opened:
                begin = opened.pop()
                self.partners |= {begin: number, number: begin}

    def refusal(self, line: int, words: str) -> InputError:
        """The error for a line."""
        return InputError(f"line {line}: {words}", file=self.path)

    def closing(self, opening: int) -> int:
        """Number of the token that closes a bracket within its statement; that of the last if none does."""
        end, last = self.partners.get(opening, len(self.tokens)), len(self.tokens) - 1
        within = self.tokens[opening].text == "{" or not any(t.text == ";" for t in self.tokens[opening:end])
        return end if within and end <= last else last


class ScriptFiles:
    """A script and the files it includes, as gmsh may see them.

    Attributes
    ----------
    files : list of Path
        What was read, the script first.
    contents : dict of str to bytes
        By their place relative to the script's folder; the first is the script.
    scripts : list
        Those of the files that are scripts.
    """

    def __init__(self, path: Path) -> None:
        self._root = path.resolve().parent
        self.files: list[Path] = []
        self.contents: dict[str, bytes] = {}
        self.scripts: list[_Script] = []
        self._places: set[str] = set()
        self._read_script(path, path.name)

    def write(self, folder: Path) -> Path:
        """Write them below ``folder``; where the script is."""
        for place, content in self.contents.items():
            step = folder
            for part in place.split("/")[:-1]:  # also those that a later ".." leaves again
                step = step / part
                step.mkdir(parents=True, exist_ok=True)
            (folder / place).write_bytes(content)
        return folder / next(iter(self.contents))

    def _read_script(self, path: Path, place: str) -> None:
        """Read and check a file as a script."""
        if place in self._places:
            return
        self._places.add(place)
        data = read_bytes(path).removeprefix(b"\xef\xbb\xbf")
        text = data.decode("latin-1")
        if found := _UNPRINTED.search(text):
            line = text.count("\n", 0, found.start()) + 1
            raise InputError(f"line {line}: is no text file, hence no gmsh script", file=path)
        script = _Script(path, list(_code(text, path)))
        # gmsh leaves out a last line that does not end
        self._keep(path, place, (_without_comments(text) + "\n").encode("latin-1"))
        _check_jumps(script, self.contents[place].decode("latin-1"))
        _collect_names(script)
        self.scripts.append(script)
        for number, token in enumerate(script.tokens):
            if token.text in _INCLUDES and token.kind == "word":
                self._follow(script, number, place)
        self._options(path, place)

    def _read_any(self, path: Path, place: str) -> None:
        """Read a file as a script or as data, whichever its content says."""
        if place in self.contents:
            if place not in self._places and not _is_data(path.name, self.contents[place]):
                self._read_script(path, place)
            return
        data = read_bytes(path)
        if not _is_data(path.name, data):
            self._read_script(path, place)
            return
        self._keep(path, place, data)
        self._options(path, place)

    def _keep(self, path: Path, place: str, content: bytes) -> None:
        if place not in self.contents:
            self.files.append(path)
        self.contents[place] = content

    def _options(self, path: Path, place: str) -> None:
        options = path.with_name(path.name + ".opt")
        if options.is_file():
            if not options.resolve().is_relative_to(self._root):
                raise InputError("is not in the folder of the script", file=options)
            self._read_script(options, place + ".opt")

    def _follow(self, script: _Script, number: int, place: str) -> None:
        """Check the file that a statement includes."""
        name, command = _name(script, number), script.tokens[number]
        quoted = f"{one_line(name)[:80]!r}"
        shown = f"'{command.text}' of {quoted}"
        target = _place(place, name)
        # the bytes of the script are the bytes of the file's name
        there = script.path.parent / os.fsdecode(name.encode("latin-1"))
        try:
            inside = target is not None and there.resolve().is_relative_to(self._root)
            exists = inside and there.is_file()
        except (OSError, ValueError, RuntimeError):
            inside = exists = False
        if target is None or not inside:
            where = "the folder of the script, as what it includes must be (by a name relative to the script)"
            raise script.refusal(command.line, f"{shown}, which is not in {where}")
        if not exists:
            raise script.refusal(command.line, f"includes {quoted}, which does not exist")
        if command.text == "Include":
            if target in self.contents and target not in self._places:
                raise script.refusal(command.line, f"{shown}, which is no script")
            self._read_script(there, target)
        else:
            self._read_any(there, target)


def check_script(path: Path) -> ScriptFiles:
    """Read a script and what it includes, and refuse all that does not describe geometry and mesh size.

    ``Include`` and ``Merge`` may name files in or below the script's folder, relative to the script that
    includes. Meshes and CAD files are recognised by content and ending; all other files are scripts, as is
    the .opt that gmsh reads beside any file, and are checked alike.

    Raises
    ------
    InputError
        A statement that is not on the list, with line and word; text that gmsh would read otherwise than it
        looks; a file outside the folder.
    """
    checked = ScriptFiles(path)
    names = set().union(*(script.names for script in checked.scripts))
    for script in checked.scripts:
        for number, token in enumerate(script.tokens):
            if token.kind == "word":
                _check_word(script, number, names)
    return checked


def _place(includer: str, name: str) -> str | None:
    """Place of an included file relative to the first script's folder; None if that is left on the way."""
    steps = includer.split("/")[:-1]
    if name.startswith("/") or not name:
        return None
    for step in name.split("/"):
        if step == "..":
            if not steps:
                return None
            steps.pop()
        elif step not in ("", "."):
            steps.append(os.fsdecode(step.encode("latin-1")))
    return "/".join(steps) or None


def _is_data(name: str, content: bytes) -> bool:
    """Whether gmsh reads a file as mesh or CAD data: by its ending, as gmsh spells it, and its content."""
    for endings, mark in _DATA_MARKS.items():
        if name.endswith(endings):
            return mark.match(content) is not None or (endings[0] == ".stl" and _is_binary_stl(content))
    return False


def _is_binary_stl(content: bytes) -> bool:
    return len(content) >= 84 and len(content) == 84 + 50 * int.from_bytes(content[80:84], "little")


# -- words -------------------------------------------------------------------------------------------


def _code(text: str, path: Path) -> Iterator[_Token]:
    """The tokens of a script without its comments."""
    line, at = 1, 0
    for match in _TOKEN.finditer(text):
        line += text.count("\n", at, match.start())
        at = match.start()
        kind, found = match.lastgroup or "", match[0]
        if kind == "comment":
            continue
        if kind == "sign" and found not in _SIGNS:
            raise InputError(f"line {line}: {found!r} has no meaning in a mesh script", file=path)
        if kind == "word" and len(found) > LONGEST_WORD:
            raise InputError(
                f"line {line}: a name of {len(found)} characters; at most {LONGEST_WORD} are read", file=path
            )
        if kind == "text":
            if len(found) < 2 or found[-1] != found[0]:
                raise InputError(f"line {line}: a text in quotes does not end", file=path)
            if len(found) > LONGEST_STRING:
                raise InputError(
                    f"line {line}: a text of {len(found)} characters; gmsh reads at most {LONGEST_STRING}",
                    file=path,
                )
        yield _Token(kind, found, line)


def _without_comments(text: str) -> str:
    """A script with the same words on the same lines."""

    def replace(match: re.Match[str]) -> str:
        return " " + "\n" * match[0].count("\n") if match.lastgroup == "comment" else match[0]

    return _TOKEN.sub(replace, text)


def _check_jumps(script: _Script, text: str) -> None:
    """Refuse scripts in which gmsh could find other words than we do.

    At If, For and Macro it skips characters, not words.
    """
    if not any(token.kind == "word" and token.text in JUMPS for token in script.tokens):
        return
    why = "where a script has If, For or Macro, gmsh may read on"
    for token in script.tokens:
        if token.kind == "text" and (found := _JUMP_IN_TEXT.search(token.text)):
            line = token.line + token.text.count("\n", 0, found.start())
            raise script.refusal(line, f"'{found[0]}' stands in a quoted text: {why} from there")
        if token.kind == "text" and ("\n" in token.text or "\r" in token.text):
            raise script.refusal(token.line, f"a quoted text of several lines: {why} within it")
        if token.kind == "word" and token.text not in JUMPS and _JUMP_IN_WORD.search(token.text):
            raise script.refusal(token.line, f"'{token.text}': {why} within it")
    for number, line_text in enumerate(text.split("\n"), 1):
        if len(line_text) > LONGEST_LINE:
            words = f"{len(line_text)} characters; {why} within lines above {LONGEST_LINE}"
            raise script.refusal(number, words)


def _collect_names(script: _Script) -> None:
    """The names to which the script gives a value."""
    tokens, names = script.tokens, script.names
    for number, token in enumerate(tokens):
        if token.kind != "word":
            continue
        if _assigned(script, number):
            names.add(token.text)
        after = tokens[number + 1] if number + 1 < len(tokens) else None
        if token.text in ("For", "Macro", "Function", "Call") and after and after.kind == "word":
            names.add(after.text)
        if token.text in ("DefineConstant", "DefineNumber", "DefineString", "UndefineConstant"):
            names |= set(_listed(script, number + 1))
    names -= REFUSED.keys()
    names -= RESERVED


def _listed(script: _Script, opening: int) -> Iterator[str]:
    """The names in the brackets of a DefineConstant."""
    tokens = script.tokens
    opening = next((n for n in range(opening, len(tokens)) if tokens[n].kind == "sign"), opening)
    depth = 1 if opening < len(tokens) and tokens[opening].text in _CLOSING else 0
    for number in range(opening + 1, script.partners.get(opening, len(tokens))):
        if depth and tokens[number].kind == "sign":
            depth += (tokens[number].text in _CLOSING) - (tokens[number].text in _CLOSING.values())
        elif depth == 1 and tokens[number].kind == "word" and tokens[number - 1].text in ("[", "(", ",", "{"):
            yield tokens[number].text


def _assigned(script: _Script, number: int) -> bool:
    """Whether a name, with its indices, is followed by a sign that gives it a value."""
    tokens, at = script.tokens, number + 1
    while at < len(tokens) and tokens[at].kind == "sign":
        text = tokens[at].text
        if text == "~":
            at += 1
        elif text in _CLOSING:
            at = script.closing(at) + 1
        else:
            return text in _ASSIGNS
    return False


def _check_word(script: _Script, number: int, names: set[str]) -> None:
    """Refuse a word that is not on the lists, or not where it belongs."""
    tokens, token = script.tokens, script.tokens[number]
    word = token.text
    before = tokens[number - 1] if number else None
    after = tokens[number + 1] if number + 1 < len(tokens) else None

    def refuse(why: str = "is no statement that is known here") -> InputError:
        return script.refusal(token.line, f"'{word}' {why}; {REMEDY}")

    if (why := REFUSED.get(word)) is not None:
        raise refuse(why)
    if word.endswith("FileName") and word != "CurrentFileName":
        raise refuse("reads what the scene does not name")
    if before is not None and before.text == ".":
        if not _is_option(script, number):
            raise refuse("is no option that is known here")
        return
    if word in RESERVED:
        raise refuse()
    if word == "Printf":
        _check_printf(script, number)
    if word in _FORMATTING:
        _check_format(script, number)
    if word in ("Macro", "Function") and not (after and after.kind == "word" and after.text in names):
        raise refuse("must be followed by a name")
    known = word in STATEMENTS or word in OPERANDS
    if _begins_statement(script, number):
        if word not in STATEMENTS and not _assigned(script, number):
            raise refuse()
    elif not known and word not in names and not COLOUR.fullmatch(word):
        raise refuse()
    if not known and after is not None and after.kind in ("text", "number"):
        raise refuse()


def _begins_statement(script: _Script, number: int) -> bool:
    tokens = script.tokens
    if number == 0 or tokens[number - 1].text in _BEFORE_STATEMENT:
        return True
    if tokens[number - 1].text == ")":  # of an If (…) or For (…)
        opening = script.partners.get(number - 1, 0)
        return opening > 0 and tokens[opening - 1].text in ("If", "ElseIf", "For")
    return number > 1 and tokens[number - 2].text in ("Macro", "Function")


def _is_option(script: _Script, number: int) -> bool:
    """Whether the word after a dot is an option of the group before it."""
    tokens, at = script.tokens, number - 2
    if at >= 0 and tokens[at].text in ("]", ")"):
        opening = script.partners.get(at, 0)
        return opening > 0 and tokens[opening - 1].text == "Field" and tokens[number].text in OPTIONS["Field"]
    if at >= 0 and tokens[at].text == "Color":
        return (
            at > 0
            and tokens[at - 1].text == "."
            and re.fullmatch("[A-Z][a-z]+", tokens[number].text) is not None
        )
    group, option = tokens[at].text if at >= 0 else "", tokens[number].text
    if group in NUMBERED:
        return option not in JUMPS and not option.endswith("Command")
    return group != "Field" and option in OPTIONS.get(group, ())


def _check_printf(script: _Script, number: int) -> None:
    """Refuse a ``Printf`` that goes to a file, or might where gmsh jumps."""
    tokens = script.tokens
    line = tokens[number].line
    closing = script.closing(number + 1) if number + 1 < len(tokens) else number
    inside = tokens[number + 1 : closing]
    ends = closing + 1 < len(tokens) and tokens[closing + 1].text == ";"
    if (
        not inside
        or inside[0].text != "("
        or not ends
        or any(t.text in JUMPS for t in inside if t.kind == "word")
    ):
        raise script.refusal(line, f"'Printf' writes files; {REMEDY}")


def _check_format(script: _Script, number: int) -> None:
    """Refuse formats with which printf would read or write foreign memory: all but those of numbers."""
    token, following = script.tokens[number], script.tokens[number + 1 : number + 4]
    kinds = [(t.kind, t.text) for t in following]
    if len(kinds) < 3 or kinds[0][1] != "(" or kinds[1][0] != "text" or kinds[2][1] not in (",", ")"):
        raise script.refusal(token.line, f"'{token.text}' must be followed by (\"text\"…)")
    text = following[1].text
    if "%" not in text:
        return
    if "%" in _NUMBER_FORMAT.sub("", text):
        words = f"a '%' in a text of '{token.text}' must begin the format of a number, such as %g or %12.3f"
        raise script.refusal(token.line, words)
    if len(text) > LONGEST_FORMAT:
        words = f"a format of {len(text)} characters; at most {LONGEST_FORMAT} are read"
        raise script.refusal(token.line, words)


def _name(script: _Script, number: int) -> str:
    """The file that an ``Include`` or ``Merge`` names."""
    command, rest = script.tokens[number], script.tokens[number + 1 : number + 3]
    if len(rest) < 2 or rest[0].kind != "text" or rest[1].text != ";":
        words = f"'{command.text}' must be followed by the file's name in quotes"
        raise script.refusal(command.line, words)
    name = rest[0].text[1:-1]
    allowed = _INCLUDES[command.text]
    if Path(name).suffix.lower() not in allowed:
        words = f"'{command.text}' of {one_line(name)[:80]!r}; {', '.join(allowed)} are read"
        raise script.refusal(command.line, words)
    return name
