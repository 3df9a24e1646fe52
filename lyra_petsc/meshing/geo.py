"""gmsh scripts (.geo), meshed by gmsh in a process of its own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from lyra_petsc.errors import InputError
from lyra_petsc.meshing.capacity import BYTES_PER_VERTEX, available_memory
from lyra_petsc.meshing.geo_script import check_script
from lyra_petsc.meshing.msh import read_msh
from lyra_petsc.meshing.sheet import Sheet
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


def mesh_geo(
    path: Path, size: float | None = None, *, key: str = "mesh", file: object | None = None
) -> Sheet:
    """Mesh a .geo script in two dimensions.

    Parameters
    ----------
    path : Path
    size : float, optional
        Element size [m] of the script's own units, in place of every size the script gives. Divisions a
        script fixes (transfinite curves) stay, with a note. Without it, a mesh that the script makes
        itself is used as it is.
    key, file
        Scene key of the source and scene file, for messages.

    Raises
    ------
    InputError
        If gmsh is missing, cannot read the script or cannot mesh it, or there are no triangles; if the
        script does what a mesh script need not (see `check_script`), or asks for more time or memory
        than there is.
    """
    if size is not None and not (np.isfinite(size) and size > 0):
        raise InputError(
            f"{size} is no element size; give a positive number [m]", key=f"{key}.size", file=file
        )
    script = check_script(path)
    with tempfile.TemporaryDirectory() as folder:
        meshed = Path(folder) / "surface.msh"
        _run_gmsh(path, size, meshed)
        try:
            sheet = read_msh(meshed, note_loose=False)  # construction points of the script
            sheet.tags = None  # those of a file that nobody sees
        except InputError as error:
            raise InputError(error.message, file=path) from None
    if script.further:
        sheet.notes.append(f"the script includes {', '.join(script.further)}")
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
        [sys.executable, "-m", "lyra_petsc.meshing.gmsh_process", str(job_file)],
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
