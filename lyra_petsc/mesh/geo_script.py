"""Check of gmsh scripts (.geo): only listed statements, which describe geometry and mesh size, are allowed.

A .geo is a program for gmsh, which can run shell commands and write files. A scene is data. Therefore each
file that gmsh will read is recognised by its content, and scripts are split into tokens as gmsh does (gmsh
4.8 to 4.15, ``src/parser/Gmsh.l``) and checked. gmsh then reads copies of the checked text without comments,
in a folder that holds nothing else.

At If, For and Macro gmsh's parser jumps by characters and lines, not by tokens, and may continue anywhere.
Therefore every word must be on a list, wherever it is, and no quoted text may look like the end of a jump.
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
"""Maximum length of a quoted text: gmsh takes characters from 1023 on for commands, and buffers of messages
that quote it have 1024."""

LONGEST_WORD = 200
"""Maximum length of a name, which messages of gmsh may quote several times."""

LONGEST_FORMAT = 120
"""Maximum length of a format string: gmsh formats each part of it into a buffer of 256."""

LONGEST_LINE = 4000
"""Maximum length of a line in a script with jumps: gmsh returns to the middle of lines above 8192."""

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
"""Statements whose text gmsh passes to printf as format (that of SetFactory in a message)."""
_NUMBER_FORMAT = re.compile(r"%[-+ 0]?\d?\d?(?:\.\d\d?)?[efgEFG]")
_BEFORE_STATEMENT = frozenset((";", "}", "Else", "EndIf", "EndFor", "Return"))

_DATA_SIGNATURES: dict[tuple[str, ...], re.Pattern[bytes]] = {
    (".msh", ".MSH"): re.compile(rb"\$MeshFormat[ \t]*\r?\n"),
    (".step", ".STEP", ".stp", ".STP"): re.compile(rb"\s*ISO-10303-21;"),
    (".iges", ".IGES", ".igs", ".IGS"): re.compile(rb"[^\n]{72}[SCB] *\d+ *\r?\n"),
    (".brep", ".brp", ".BRP"): re.compile(
        rb"\s*(?:DBRep_DrawableShape|CASCADE Topology V|Open CASCADE Topology V)"
    ),
    (".stl", ".STL"): re.compile(rb"\s*solid\b"),
}
"""Beginning of mesh and CAD files, by the endings by which gmsh recognises their format."""

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
    """For each bracket, opening or closing, the index of the token of its counterpart."""

    def __post_init__(self) -> None:
        opened: list[int] = []
        for number, token in enumerate(self.tokens):
            if token.kind == "sign" and token.text in _CLOSING:
                opened.append(number)
            elif token.kind == "sign" and token.text in _CLOSING.values() and opened:
                begin = opened.pop()
                self.partners |= {begin: number, number: begin}

    def error(self, line: int, message: str) -> InputError:
        """The error for a line."""
        return InputError(f"line {line}: {message}", file=self.path)

    def closing(self, opening: int) -> int:
        """Index of the token that closes a bracket within its statement, or of the last token if none."""
        end, last = self.partners.get(opening, len(self.tokens)), len(self.tokens) - 1
        within = self.tokens[opening].text == "{" or not any(t.text == ";" for t in self.tokens[opening:end])
        return end if within and end <= last else last


class ScriptFiles:
    """A script and the files it includes, with the content that gmsh reads.

    Attributes
    ----------
    files : list of Path
        All files, the script first.
    contents : dict of str to bytes
        Content by path relative to the script's folder, the script first.
    scripts : list
        The files that are scripts, as tokens.
    """

    def __init__(self, path: Path) -> None:
        self._root = path.resolve().parent
        self.files: list[Path] = []
        self.contents: dict[str, bytes] = {}
        self.scripts: list[_Script] = []
        self._script_names: set[str] = set()
        self._read_script(path, path.name)

    def write(self, folder: Path) -> Path:
        """Write all contents below ``folder``; returns the path of the script."""
        for name, content in self.contents.items():
            directory = folder
            for part in name.split("/")[:-1]:  # also those that a later ".." leaves
                directory = directory / part
                directory.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
        return folder / next(iter(self.contents))

    def _read_script(self, path: Path, name: str) -> None:
        """Read and check a script; ``name`` is its path relative to the first script's folder."""
        if name in self._script_names:
            return
        self._script_names.add(name)
        data = read_bytes(path).removeprefix(b"\xef\xbb\xbf")
        text = data.decode("latin-1")
        if found := _UNPRINTED.search(text):
            line = text.count("\n", 0, found.start()) + 1
            raise InputError(f"line {line}: is no text file, hence no gmsh script", file=path)
        script = _Script(path, list(_tokens(text, path)))
        # gmsh ignores a last line without newline
        self._store(path, name, (_without_comments(text) + "\n").encode("latin-1"))
        _check_jumps(script, self.contents[name].decode("latin-1"))
        _collect_names(script)
        self.scripts.append(script)
        for number, token in enumerate(script.tokens):
            if token.text in _INCLUDES and token.kind == "word":
                self._read_included(script, number, name)
        self._read_options(path, name)

    def _read_merged(self, path: Path, name: str) -> None:
        """Read a file as data if its content says so, else as a script."""
        if name in self.contents:
            if name not in self._script_names and not _is_data(path.name, self.contents[name]):
                self._read_script(path, name)
            return
        data = read_bytes(path)
        if not _is_data(path.name, data):
            self._read_script(path, name)
            return
        self._store(path, name, data)
        self._read_options(path, name)

    def _store(self, path: Path, name: str, content: bytes) -> None:
        if name not in self.contents:
            self.files.append(path)
        self.contents[name] = content

    def _read_options(self, path: Path, name: str) -> None:
        """Read the .opt file beside a file, if there is one: gmsh reads it, too."""
        options = path.with_name(path.name + ".opt")
        if options.is_file():
            if not options.resolve().is_relative_to(self._root):
                raise InputError("is not in the folder of the script", file=options)
            self._read_script(options, name + ".opt")

    def _read_included(self, script: _Script, number: int, includer: str) -> None:
        """Read and check the file that the statement at token ``number`` of ``includer`` includes."""
        given, command = _included_name(script, number), script.tokens[number]
        quoted = f"{one_line(given)[:80]!r}"
        shown = f"'{command.text}' of {quoted}"
        target = _relative_path(includer, given)
        # scripts are decoded as latin-1, so that this restores the bytes of the name
        path = script.path.parent / os.fsdecode(given.encode("latin-1"))
        try:
            inside = target is not None and path.resolve().is_relative_to(self._root)
            exists = inside and path.is_file()
        except (OSError, ValueError, RuntimeError):
            inside = exists = False
        if target is None or not inside:
            where = "the folder of the script, as what it includes must be (by a name relative to the script)"
            raise script.error(command.line, f"{shown}, which is not in {where}")
        if not exists:
            raise script.error(command.line, f"includes {quoted}, which does not exist")
        if command.text == "Include":
            if target in self.contents and target not in self._script_names:
                raise script.error(command.line, f"{shown}, which is no script")
            self._read_script(path, target)
        else:
            self._read_merged(path, target)


def check_script(path: Path) -> ScriptFiles:
    """Read a script and the files it includes; refuse what does not describe geometry and mesh size.

    ``Include`` and ``Merge`` may name files in or below the script's folder, relative to the including
    script. Mesh and CAD files are recognised by content and ending. All other files are checked as scripts,
    also the .opt files that gmsh reads beside any file.

    Raises
    ------
    InputError
        A word that is not on the lists, with its line; text that gmsh may split into other tokens; a file
        outside of the folder.
    """
    checked = ScriptFiles(path)
    names = set().union(*(script.names for script in checked.scripts))
    for script in checked.scripts:
        for number, token in enumerate(script.tokens):
            if token.kind == "word":
                _check_word(script, number, names)
    return checked


def _relative_path(includer: str, name: str) -> str | None:
    """Path of an included file relative to the first script's folder; None if it leaves this folder."""
    parts = includer.split("/")[:-1]
    if name.startswith("/") or not name:
        return None
    for part in name.split("/"):
        if part == "..":
            if not parts:
                return None
            parts.pop()
        elif part not in ("", "."):
            parts.append(os.fsdecode(part.encode("latin-1")))
    return "/".join(parts) or None


def _is_data(name: str, content: bytes) -> bool:
    """Whether gmsh reads a file as mesh or CAD data, by its ending (in gmsh's spelling) and its content."""
    for endings, signature in _DATA_SIGNATURES.items():
        if name.endswith(endings):
            return signature.match(content) is not None or (endings[0] == ".stl" and _is_binary_stl(content))
    return False


def _is_binary_stl(content: bytes) -> bool:
    return len(content) >= 84 and len(content) == 84 + 50 * int.from_bytes(content[80:84], "little")


# -- tokens ------------------------------------------------------------------------------------------


def _tokens(text: str, path: Path) -> Iterator[_Token]:
    """The tokens of a script, without comments."""
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
    """The script with its comments replaced by blanks; all tokens keep their lines."""

    def replace(match: re.Match[str]) -> str:
        return " " + "\n" * match[0].count("\n") if match.lastgroup == "comment" else match[0]

    return _TOKEN.sub(replace, text)


def _check_jumps(script: _Script, text: str) -> None:
    """Refuse scripts with jumps in which gmsh may see other tokens than `_tokens`.

    At If, For and Macro gmsh skips characters, not tokens.
    """
    if not any(token.kind == "word" and token.text in JUMPS for token in script.tokens):
        return
    why = "where a script has If, For or Macro, gmsh may read on"
    for token in script.tokens:
        if token.kind == "text" and (found := _JUMP_IN_TEXT.search(token.text)):
            line = token.line + token.text.count("\n", 0, found.start())
            raise script.error(line, f"'{found[0]}' stands in a quoted text: {why} from there")
        if token.kind == "text" and ("\n" in token.text or "\r" in token.text):
            raise script.error(token.line, f"a quoted text of several lines: {why} within it")
        if token.kind == "word" and token.text not in JUMPS and _JUMP_IN_WORD.search(token.text):
            raise script.error(token.line, f"'{token.text}': {why} within it")
    for number, line_text in enumerate(text.split("\n"), 1):
        if len(line_text) > LONGEST_LINE:
            message = f"{len(line_text)} characters; {why} within lines above {LONGEST_LINE}"
            raise script.error(number, message)


def _collect_names(script: _Script) -> None:
    """Collect the names that the script defines."""
    tokens, names = script.tokens, script.names
    for number, token in enumerate(tokens):
        if token.kind != "word":
            continue
        if _is_assigned(script, number):
            names.add(token.text)
        after = tokens[number + 1] if number + 1 < len(tokens) else None
        if token.text in ("For", "Macro", "Function", "Call") and after and after.kind == "word":
            names.add(after.text)
        if token.text in ("DefineConstant", "DefineNumber", "DefineString", "UndefineConstant"):
            names |= set(_defined_constants(script, number + 1))
    names -= REFUSED.keys()
    names -= RESERVED


def _defined_constants(script: _Script, opening: int) -> Iterator[str]:
    """The names that a DefineConstant defines; its bracket opens at or after token ``opening``."""
    tokens = script.tokens
    opening = next((n for n in range(opening, len(tokens)) if tokens[n].kind == "sign"), opening)
    depth = 1 if opening < len(tokens) and tokens[opening].text in _CLOSING else 0
    for number in range(opening + 1, script.partners.get(opening, len(tokens))):
        if depth and tokens[number].kind == "sign":
            depth += (tokens[number].text in _CLOSING) - (tokens[number].text in _CLOSING.values())
        elif depth == 1 and tokens[number].kind == "word" and tokens[number - 1].text in ("[", "(", ",", "{"):
            yield tokens[number].text


def _is_assigned(script: _Script, number: int) -> bool:
    """Whether an assignment operator follows the name at token ``number`` and its indices."""
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
    """Refuse a word that is not on the lists, or not allowed at its position."""
    tokens, token = script.tokens, script.tokens[number]
    word = token.text
    before = tokens[number - 1] if number else None
    after = tokens[number + 1] if number + 1 < len(tokens) else None

    def refuse(why: str = "is no statement that is known here") -> InputError:
        return script.error(token.line, f"'{word}' {why}; {REMEDY}")

    if (why := REFUSED.get(word)) is not None:
        if word == "Save":
            why += ", of which none is needed: take it out"
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
        if word not in STATEMENTS and not _is_assigned(script, number):
            raise refuse()
    elif not known and word not in names and not COLOUR.fullmatch(word):
        raise refuse()
    if not known and after is not None and after.kind in ("text", "number"):
        raise refuse()


def _begins_statement(script: _Script, number: int) -> bool:
    """Whether the token begins a statement."""
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
    """Refuse a ``Printf`` that writes to a file, or may do so after a jump."""
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
        raise script.error(line, f"'Printf' writes files; {REMEDY}")


def _check_format(script: _Script, number: int) -> None:
    """Refuse all formats but those of numbers: printf could read or write any memory with others."""
    token, following = script.tokens[number], script.tokens[number + 1 : number + 4]
    kinds = [(t.kind, t.text) for t in following]
    if len(kinds) < 3 or kinds[0][1] != "(" or kinds[1][0] != "text" or kinds[2][1] not in (",", ")"):
        raise script.error(token.line, f"'{token.text}' must be followed by (\"text\"…)")
    text = following[1].text
    if "%" not in text:
        return
    if "%" in _NUMBER_FORMAT.sub("", text):
        message = f"a '%' in a text of '{token.text}' must begin the format of a number, such as %g or %12.3f"
        raise script.error(token.line, message)
    if len(text) > LONGEST_FORMAT:
        message = f"a format of {len(text)} characters; at most {LONGEST_FORMAT} are read"
        raise script.error(token.line, message)


def _included_name(script: _Script, number: int) -> str:
    """The file name in an ``Include`` or ``Merge`` statement."""
    command, rest = script.tokens[number], script.tokens[number + 1 : number + 3]
    if len(rest) < 2 or rest[0].kind != "text" or rest[1].text != ";":
        message = f"'{command.text}' must be followed by the file's name in quotes"
        raise script.error(command.line, message)
    name = rest[0].text[1:-1]
    allowed = _INCLUDES[command.text]
    if Path(name).suffix.lower() not in allowed:
        message = f"'{command.text}' of {one_line(name)[:80]!r}; {', '.join(allowed)} are read"
        raise script.error(command.line, message)
    return name
