"""gmsh scripts (.geo), meshed by gmsh in a process of its own; `geo_script` has what they may say."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from lyra_petsc.errors import InputError
from lyra_petsc.mesh.capacity import BYTES_PER_VERTEX, available_memory
from lyra_petsc.mesh.geo_script import check_script
from lyra_petsc.mesh.mesh import Sheet
from lyra_petsc.mesh.msh_file import ElementBlock, MshError, assemble, element_type
from lyra_petsc.mesh.readers import printable
from lyra_petsc.scene.text import read_bytes
from lyra_petsc.scene.values import one_line

# beyond this ratio of the mean edge to the size asked for, the script sets sizes of its own
_SIZE_RATIO = 1.6

SCRIPT_SECONDS = 60
"""CPU time a script may take until gmsh begins to mesh: one that loops for ever ends here."""

MESH_SECONDS = 3600
"""CPU time gmsh may take to mesh."""

FIRST_WORD = 5.0
"""Seconds until it is said what gmsh does; then twice as many, and so on, at most `LONGEST_SILENCE`."""

LONGEST_SILENCE = 60.0

ALGORITHMS = {"mesh-adapt": 1, "automatic": 2, "delaunay": 5, "frontal-delaunay": 6}
"""gmsh's algorithms for triangles, by their names and their numbers there (``Mesh.Algorithm``)."""

_WAIT = 4.0
"""Times the CPU time allowed that we wait for gmsh, on a machine with other work to do."""

# variables by which an MPI in gmsh's process would take itself for one of our ranks
_MPI_VARIABLES = ("OMPI_", "PMIX_", "PMI_", "HYDRA_", "MPI_", "SLURM_")


def mesh_geo(
    path: Path,
    size: float | None = None,
    *,
    algorithm: str | None = None,
    trusted: bool = False,
    report: Callable[[str], None] | None = None,
) -> Sheet:
    """Mesh a .geo script in two dimensions.

    Parameters
    ----------
    path : Path
    size : float, optional
        Element size [m] of the script's own units, in place of every size the script gives. Divisions a
        script fixes (transfinite curves) stay, with a note. Without it, a mesh that the script makes
        itself is used as it is.
    algorithm : str, optional
        One of `ALGORITHMS`, in place of the script's. Without it the mesh is what gmsh alone makes of the
        script.
    trusted : bool
        Give gmsh the script as it is, whatever it says.
    report : callable, optional
        Called with a line now and then while gmsh is at work.

    Raises
    ------
    InputError
        If gmsh is missing, cannot read the script or cannot mesh it, or there are no triangles; if the
        script does what a mesh script need not (see `check_script`), or asks for more time or memory
        than there is.
    """
    files: list[Path] = []
    wishes = {"size": size, "algorithm": None if algorithm is None else ALGORITHMS[algorithm]}
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryFile() as meshed:
        if trusted:
            read_bytes(path)  # for its errors
            _run_gmsh(path, path.absolute(), None, wishes, Path(folder), meshed, report)
        else:
            checked = check_script(path)
            files = checked.files
            copies = Path(folder) / "script"
            copies.mkdir()
            _run_gmsh(path, checked.write(copies), copies, wishes, Path(folder), meshed, report)
        sheet = _read_mesh(path, meshed)
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


def _run_gmsh(
    path: Path,
    script: Path,
    readable: Path | None,
    wishes: dict[str, Any],
    folder: Path,
    meshed: BinaryIO,
    report: Callable[[str], None] | None,
) -> None:
    """Mesh the script in another process, which writes ``meshed``; its errors are raised here."""
    memory = available_memory()
    job = {
        "script": str(script),
        "folder": None if readable is None else str(readable),
        **wishes,
        "script_seconds": SCRIPT_SECONDS,
        "mesh_seconds": MESH_SECONDS,
        "memory": memory,
        "most_triangles": 2 * memory // BYTES_PER_VERTEX,
    }
    job_file = folder / "job.json"
    job_file.write_text(json.dumps(job))
    environment = {name: value for name, value in os.environ.items() if not name.startswith(_MPI_VARIABLES)}
    environment["PYTHONPATH"] = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
    environment["GMSH_HOME"] = str(folder)  # no .gmshrc of the user's
    with tempfile.TemporaryFile() as told:
        descriptors = told.fileno(), meshed.fileno()
        process = subprocess.Popen(
            [sys.executable, "-m", "lyra_petsc.mesh.gmsh_process", str(job_file), *map(str, descriptors)],
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            pass_fds=descriptors,
            start_new_session=True,  # Ctrl-C is for the run, which ends us in its own time
        )
        try:
            errors = _wait(process, told, lambda line: report and report(f"{path.name}: {line}"))
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
        outcome = _outcome(told)
    if "refused" in outcome:
        raise InputError(one_line(outcome["refused"]), file=path)
    if outcome.get("stage") != "done" or process.returncode != 0:
        words = _ending(outcome.get("stage", ""), process.returncode, errors, memory)
        raise InputError(words, file=path)


def _wait(process: subprocess.Popen[bytes], told: BinaryIO, report: Callable[[str], None]) -> bytes:
    """Wait for gmsh's process, telling the user now and then; returns what it wrote to stderr."""
    began = time.monotonic()
    pause = FIRST_WORD
    while time.monotonic() - began < _WAIT * (SCRIPT_SECONDS + MESH_SECONDS):
        try:
            return process.communicate(timeout=pause)[1]
        except subprocess.TimeoutExpired:
            pause = min(2.0 * pause, LONGEST_SILENCE)
        outcome = _outcome(told)
        if outcome.get("stage") != "mesh" and time.monotonic() - began < 2.0 * FIRST_WORD:
            continue  # most that takes long to read never ends, and is ended soon
        doing = "is meshing" if outcome.get("stage") == "mesh" else "is reading the script"
        if "triangles" in outcome:
            doing += f", roughly {float('{:.1g}'.format(outcome['triangles'])):,.0f} triangles"
        report(f"gmsh {doing}, {time.monotonic() - began:.0f} s so far")
    return b""


def _outcome(told: BinaryIO) -> dict[str, Any]:
    """What gmsh's process has reported, the latest entry of each kind."""
    outcome: dict[str, Any] = {}
    # not by seeking: the place in the file is that of gmsh's process, too
    for line in os.pread(told.fileno(), os.fstat(told.fileno()).st_size, 0).splitlines():
        with suppress(ValueError):
            outcome |= json.loads(line)
    return outcome


def _read_mesh(path: Path, file: BinaryIO) -> Sheet:
    """The mesh that gmsh's process wrote (`gmsh_process._write_mesh`)."""
    file.seek(0)
    head = json.loads(np.load(file, allow_pickle=False).tobytes())
    tags, points = np.load(file, allow_pickle=False), np.load(file, allow_pickle=False)
    blocks = []
    try:
        for kind, entity, groups in head["blocks"]:
            corners = np.load(file, allow_pickle=False)
            element_type(kind)
            count, members = len(corners), np.array(groups, dtype=np.int64)
            rows = np.column_stack([np.tile(np.arange(count), len(members)), np.repeat(members, count)])
            blocks.append(ElementBlock(kind, corners, np.full(count, entity), rows))
        names = {(dimension, tag): printable(name) for dimension, tag, name in head["names"]}
        sheet = assemble(tags, points, blocks, names, note_loose=False)  # construction points of the script
    except MshError as error:
        raise InputError(f"the mesh has {error}", file=path) from None
    sheet.tags = None  # those of a temporary file
    return sheet


def _ending(stage: str, code: int, errors: bytes, memory: int) -> str:
    """Why gmsh did not finish, for the message."""
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
