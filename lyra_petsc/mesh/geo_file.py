"""gmsh scripts (.geo): what they may say, and how they are meshed by gmsh in a process of its own.

A .geo is a program for gmsh, which would run shell commands and write files for it. A scene is data; so
the script is read before gmsh sees it, word by word as gmsh's own reader does (gmsh 4.8 to 4.13,
``src/parser/Gmsh.l``).
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lyra_petsc.errors import InputError
from lyra_petsc.mesh.capacity import BYTES_PER_VERTEX, available_memory
from lyra_petsc.mesh.mesh import Sheet
from lyra_petsc.mesh.msh_file import read_msh
from lyra_petsc.mesh.readers import read_bytes
from lyra_petsc.scene.values import one_line

# beyond this ratio of the mean edge to the size asked for, the script has had its own way
_SIZE_RATIO = 1.6

SCRIPT_SECONDS = 60
"""CPU time a script may take until gmsh begins to mesh: one that loops for ever ends here."""

MESH_SECONDS = 3600
"""CPU time gmsh may take to mesh."""

_WAIT = 4.0
"""Times the CPU time allowed that we wait for gmsh, on a machine with other work to do."""

# variables by which an MPI in gmsh's process would take itself for one of our ranks
_MPI_VARIABLES = ("OMPI_", "PMIX_", "PMI_", "HYDRA_", "MPI_", "SLURM_")


def mesh_geo(path: Path, size: float | None = None) -> Sheet:
    """Mesh a .geo script in two dimensions.

    Parameters
    ----------
    path : Path
    size : float, optional
        Element size [m] of the script's own units, in place of every size the script gives. Divisions a
        script fixes (transfinite curves) stay, with a note. Without it, a mesh that the script makes
        itself is used as it is.

    Raises
    ------
    InputError
        If gmsh is missing, cannot read the script or cannot mesh it, or there are no triangles; if the
        script does what a mesh script need not (see `check_script`), or asks for more time or memory
        than there is.
    """
    files = check_script(path)
    with tempfile.TemporaryDirectory() as folder:
        meshed = Path(folder) / "surface.msh"
        _run_gmsh(path, size, meshed)
        try:
            sheet = read_msh(meshed, note_loose=False)  # construction points of the script
            sheet.tags = None  # those of a file that nobody sees
        except InputError as error:
            raise InputError(error.message, file=path) from None
    if len(files) > 1:
        sheet.notes.append(f"the script includes {', '.join(file.name for file in files[1:])}")
    if size is not None:
        corners = sheet.points[sheet.triangles]
        mean = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean())
        if not 1 / _SIZE_RATIO < mean / size < _SIZE_RATIO:
            sheet.notes.append(
                f"mean edge {mean:.3g} m though size {size:g} m is asked for: "
                "the script fixes its divisions, or is smaller than that"
            )
    return sheet


def _run_gmsh(path: Path, size: float | None, meshed: Path) -> None:
    """Have the script meshed into ``meshed`` by another process; its failures are ours."""
    memory = available_memory()
    job = {
        "script": str(path.absolute()),
        "size": size,
        "mesh": str(meshed),
        "script_seconds": SCRIPT_SECONDS,
        "mesh_seconds": MESH_SECONDS,
        "memory": memory,
        "most_triangles": 2 * memory // BYTES_PER_VERTEX,
    }
    folder = meshed.parent
    job_file, outcome_file = folder / "job.json", folder / "outcome.json"
    job_file.write_text(json.dumps(job))
    environment = {name: value for name, value in os.environ.items() if not name.startswith(_MPI_VARIABLES)}
    environment["PYTHONPATH"] = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
    process = subprocess.Popen(
        [sys.executable, "-m", "lyra_petsc.mesh.gmsh_process", str(job_file)],
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,  # Ctrl-C is for the run, which ends us in its own time
    )
    try:
        _, errors = process.communicate(timeout=_WAIT * (SCRIPT_SECONDS + MESH_SECONDS))
    except subprocess.TimeoutExpired:
        errors = b""
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
    try:
        outcome: dict[str, str] = json.loads(outcome_file.read_text())
    except (OSError, ValueError):
        outcome = {}
    if "refused" in outcome:
        raise InputError(one_line(outcome["refused"]), file=path)
    if outcome.get("stage") != "done" or process.returncode != 0:
        words = _ending(outcome.get("stage", ""), process.returncode, errors, memory)
        raise InputError(words, file=path)


def _ending(stage: str, code: int, errors: bytes, memory: int) -> str:
    """Why gmsh did not come to its end, in words."""
    doing = "meshing" if stage == "mesh" else "reading the script"
    if stage == "memory" or b"bad_alloc" in errors or b"MemoryError" in errors:
        return (
            f"gmsh needs more than the {memory / 2**30:.3g} GiB there are, {doing}: "
            "is a mesh size too small, or a loop too long?"
        )
    if code in (-signal.SIGXCPU, -signal.SIGKILL):
        seconds = MESH_SECONDS if stage == "mesh" else SCRIPT_SECONDS
        what = "are its mesh sizes too small?" if stage == "mesh" else "does it loop for ever?"
        return f"gmsh did not finish {doing} in {seconds} s of CPU time; {what}"
    if code < 0:
        return f"gmsh broke down ({signal.Signals(-code).name}) {doing}"
    last = one_line(errors.decode("utf-8", errors="replace")[-200:])
    return f"gmsh ended early ({code}) {doing}{': ' + last if last else ''}"


# -- what a script may say ---------------------------------------------------------------------------

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


def check_script(path: Path) -> list[Path]:
    """Read a script and what it includes, refuse what is no geometry; the files, the script first.

    ``Include`` and ``Merge`` may name files in or below the script's folder; those with commands
    (.geo, and the .opt that gmsh reads beside any file) are checked alike.

    Raises
    ------
    InputError
        A command that runs programs, writes or reads other files, with its line; text that gmsh would
        read otherwise than it looks.
    """
    files: list[Path] = []
    _check(path, path.resolve().parent, files)
    return files


def _check(path: Path, root: Path, files: list[Path]) -> None:
    files.append(path)
    text = read_bytes(path).decode("latin-1")
    if path.suffix.lower() in (".geo", ".opt"):
        if "\0" in text:
            raise InputError("is no text file, hence no gmsh script", file=path)
        for name, line in _included(text, path):
            _follow(name, line, path, root, files)
    options = path.with_name(path.name + ".opt")
    if options.is_file() and options not in files:
        _check(options, root, files)


def _follow(name: str, line: int, path: Path, root: Path, files: list[Path]) -> None:
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
    if all(other.resolve() != found for other in files):
        _check(there, root, files)


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
