"""Meshes by libraries in a guarded child process (`library_process`): gmsh meshes scripts (.geo); meshio, VTK
and gmsh read formats of other programs.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from lyra_petsc.errors import InputError
from lyra_petsc.mesh.capacity import BYTES_PER_VERTEX, available_memory
from lyra_petsc.mesh.library_formats import LIBRARIES, usual_spelling
from lyra_petsc.mesh.measures import SCALE_RATIO
from lyra_petsc.mesh.mesh import ElementBlock, Sheet
from lyra_petsc.mesh.msh_file import MshError, NoTrianglesError, assemble_sheet
from lyra_petsc.mesh.readers import printable
from lyra_petsc.scene.text import read_bytes
from lyra_petsc.scene.values import one_line
from lyra_petsc.startup import module_command

READ_SECONDS = 60
"""Limit on the CPU time of reading a file, for scripts that loop for ever."""

READ_RATE = 100_000
"""Bytes of other formats for each of which the time to read them may be a second longer."""

MESH_SECONDS = 3600
"""Limit on the CPU time of meshing."""

REPORT_INTERVAL = 20.0
"""Seconds between reports of progress."""

ALGORITHMS = {"mesh-adapt": 1, "automatic": 2, "delaunay": 5, "frontal-delaunay": 6}
"""Names of gmsh's algorithms for triangles, and their numbers in gmsh (``Mesh.Algorithm``)."""

WALL_TIME_RATIO = 10.0
"""Limits on the wall time, over those on the CPU time: the machine may have other work to do."""

# variables by which an MPI in gmsh's process would take itself for one of our ranks
_MPI_VARIABLES = ("OMPI_", "PMIX_", "PMI_", "HYDRA_", "MPI_", "SLURM_")


def read_by_library(
    path: Path,
    size: float | None = None,
    *,
    algorithm: str | None = None,
    trusted: bool = False,
    report: Callable[[str], None] | None = None,
) -> Sheet:
    """Mesh a .geo script in two dimensions, or read a file by the library that knows its format.

    Files of other formats keep the order of vertices and triangles in which the library returns them; what
    `msh_file.read_msh` drops or splits with a note is dropped or split here, too. Groups are those of the
    file, if the library reads them.

    Parameters
    ----------
    path : Path
    size : float, optional
        Element size in the units of a script, which replaces all sizes in the script. Fixed divisions
        (transfinite curves) stay, with a note. Without ``size``, a mesh that the script itself generates is
        used unchanged.
    algorithm : str, optional
        One of `ALGORITHMS`, which replaces that of the script.
    trusted : bool
        Let a script read any file, not only those in its folder, and run it where there is no seccomp.
    report : callable, optional
        Called with a line of progress at intervals while the library works.

    Raises
    ------
    InputError
        If the library is missing, cannot read or mesh the file, drops elements, or needs more time or memory
        than there is; if a script tries to start a program; if there are no triangles.
    """
    data = read_bytes(path)
    suffix, memory = path.suffix.lower(), available_memory()
    script = path.resolve() if suffix == ".geo" else None
    with tempfile.TemporaryDirectory() as name, tempfile.TemporaryFile() as meshed:
        folder = Path(name)
        # a copy, as libraries also read files beside it; its ending in the spelling that they know
        file = folder / f"mesh{suffix}"
        readable = [folder]
        if script is None:
            file.write_bytes(usual_spelling(suffix, data))
        else:  # included, as gmsh drops a last line without newline from any other file
            file.write_bytes(b'Include "%b";\n' % os.fsencode(script))
            readable.append(Path("/") if trusted else script.parent)
        job = {
            "file": str(file),
            "script": None if script is None else str(script),
            "readable": list(map(str, readable)),
            "guarded": script is not None and not trusted,
            "size": size,
            "algorithm": None if algorithm is None else ALGORITHMS[algorithm],
            "read_seconds": READ_SECONDS + (len(data) // READ_RATE if script is None else 0),
            "mesh_seconds": MESH_SECONDS,
            "wall_ratio": WALL_TIME_RATIO,
            "memory": memory,
            "max_triangles": 2 * memory // BYTES_PER_VERTEX,
        }
        _run_library(path, job, folder, meshed, report)
        # vertices in no triangle are construction points of a script, whose tags no file of the user's has
        sheet = _read_mesh(path, meshed, note_loose=script is None)
    sheet.tags = None
    if size is not None:
        corners = sheet.points[sheet.triangles]
        mean = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean())
        if not 1 / SCALE_RATIO < mean / size < SCALE_RATIO:
            sheet.notes.append(
                f"mean edge {mean:.3g} m though size {size:g} m is asked for: "
                "the script fixes its divisions, or is smaller than that"
            )
    return sheet


def _run_library(
    path: Path, job: dict[str, Any], folder: Path, meshed: BinaryIO, report: Callable[[str], None] | None
) -> None:
    """Do the job (`library_process.main`) in a child process, which writes the mesh to ``meshed``.

    ``path`` names the file in messages; the process works in ``folder``.

    Raises
    ------
    InputError
        As `read_by_library`.
    """
    job_file = folder / "job.json"
    job_file.write_text(json.dumps(job))
    environment = {name: value for name, value in os.environ.items() if not name.startswith(_MPI_VARIABLES)}
    environment["GMSH_HOME"] = str(folder)  # no .gmshrc of the user's
    with tempfile.TemporaryFile() as outcome_file:
        descriptors = outcome_file.fileno(), meshed.fileno()
        process = subprocess.Popen(
            [*module_command("lyra_petsc.mesh.library_process"), str(job_file), *map(str, descriptors)],
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            pass_fds=descriptors,
            start_new_session=True,  # Ctrl-C goes to this process only, which ends gmsh
        )
        try:
            errors = _wait(path, process, outcome_file, report)
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
        outcome = _read_outcome(outcome_file)
    if "refused" in outcome:
        raise InputError(one_line(outcome["refused"]), file=path)
    if outcome.get("stage") != "done" or process.returncode != 0:
        message = _failure(path, outcome.get("stage", ""), process.returncode, errors, job)
        raise InputError(message, file=path)


def _wait(
    path: Path, process: subprocess.Popen[bytes], file: BinaryIO, report: Callable[[str], None] | None
) -> bytes:
    """Wait for the library's process, reporting progress; returns what the process wrote to stderr."""
    began = time.monotonic()
    while True:
        try:
            return process.communicate(timeout=REPORT_INTERVAL)[1]
        except subprocess.TimeoutExpired:
            outcome = _read_outcome(file)
        doing = "is meshing" if outcome.get("stage") == "mesh" else "is reading it"
        if report is not None:
            library = LIBRARIES[path.suffix.lower()]
            report(f"{path.name}: {library} {doing}, {time.monotonic() - began:.0f} s so far")


def _read_outcome(file: BinaryIO) -> dict[str, Any]:
    """The latest entry of each kind that gmsh's process has written."""
    outcome: dict[str, Any] = {}
    # pread, as gmsh's process shares the file position
    for line in os.pread(file.fileno(), os.fstat(file.fileno()).st_size, 0).splitlines():
        with suppress(ValueError):
            outcome |= json.loads(line)
    return outcome


def _read_mesh(path: Path, file: BinaryIO, *, note_loose: bool) -> Sheet:
    """The mesh that the process wrote (`library_process._write_mesh`); ``note_loose`` as `assemble_sheet`."""
    file.seek(0)

    def load() -> Any:
        return np.load(file, allow_pickle=False)

    head = json.loads(load().tobytes())
    tags, points = load(), load()
    blocks = []
    try:
        for kind in head["kinds"]:
            blocks.append(ElementBlock(kind, load(), load(), load()))
        names = {(dimension, tag): printable(name) for dimension, tag, name in head["names"]}
        sheet = assemble_sheet(tags, points, blocks, names, note_loose=note_loose)
    except NoTrianglesError as error:
        raise InputError(f"the mesh has {error}", file=path) from None
    except MshError as error:
        raise InputError(f"damaged: it {error}", file=path) from None
    sheet.notes = head["notes"] + sheet.notes
    return sheet


def _failure(path: Path, stage: str, code: int, errors: bytes, job: dict[str, Any]) -> str:
    """Message on why the library did not finish."""
    library, is_script = LIBRARIES[path.suffix.lower()], job["script"] is not None
    doing = "meshing" if stage == "mesh" else f"reading the {'script' if is_script else 'file'}"
    hint = "is a mesh size too small, or a loop too long?" if is_script else "is the file damaged?"
    if code == -signal.SIGSYS:
        return f"the {'script' if is_script else 'library'} tried to start a program"
    if stage == "memory" or b"bad_alloc" in errors or b"MemoryError" in errors:
        return f"{library} needs more than the {job['memory'] / 2**30:.3g} GiB there are, {doing}: {hint}"
    if code in (-signal.SIGXCPU, -signal.SIGKILL, -signal.SIGALRM):
        seconds = job["mesh_seconds" if stage == "mesh" else "read_seconds"]
        wall = f"{job['wall_ratio'] * seconds:g} s"
        limit = wall if code == -signal.SIGALRM else f"{seconds} s of CPU time"
        return f"{library} did not finish {doing} in {limit}: {hint}"
    if code < 0:
        return f"{library} broke down ({signal.Signals(-code).name}) {doing}: {hint}"
    last = one_line(errors.decode("utf-8", errors="replace")[-200:])
    return f"{library} ended early ({code}) {doing}{': ' + last if last else ''}"
