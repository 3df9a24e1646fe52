"""gmsh scripts (.geo), meshed by gmsh on the calling process."""

from __future__ import annotations

import signal
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from lyra_petsc.errors import InputError
from lyra_petsc.meshing.files import read_bytes
from lyra_petsc.meshing.msh import read_msh
from lyra_petsc.meshing.sheet import Sheet

# beyond this ratio of the mean edge to the size asked for, the script has had its own way
_SIZE_RATIO = 1.6


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
        If gmsh is missing, cannot read the script or cannot mesh it, or there are no triangles.
    """
    read_bytes(path)
    if size is not None and not (np.isfinite(size) and size > 0):
        raise InputError(
            f"{size} is no element size; give a positive number [m]", key=f"{key}.size", file=file
        )
    with tempfile.TemporaryDirectory() as folder:
        meshed = Path(folder) / "surface.msh"
        with _session() as gmsh:
            try:
                _generate(gmsh, path, size)
                # written and read back: one way from gmsh's blocks to vertices, triangles and groups
                gmsh.write(str(meshed))
            except InputError:
                raise
            except Exception as error:  # gmsh raises nothing more precise
                raise InputError(
                    f"gmsh: {_complaint(gmsh, path) or ' '.join(str(error).split())}", file=path
                ) from None
        try:
            sheet = read_msh(meshed, note_loose=False)  # construction points of the script
            sheet.tags = None  # those of a file that nobody sees
        except InputError as error:
            raise InputError(error.message, file=path) from None
    if size is not None:
        corners = sheet.points[sheet.triangles]
        mean = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean())
        if not 1 / _SIZE_RATIO < mean / size < _SIZE_RATIO:
            sheet.notes.append(
                f"mean edge {mean:.3g} m though size {size:g} m is asked for: "
                "the script fixes its divisions, or is smaller than that"
            )
    return sheet


def _generate(gmsh: ModuleType, path: Path, size: float | None) -> None:
    gmsh.logger.start()
    _set_size(gmsh, size)
    gmsh.merge(str(path))  # not open, which clears the models of a session that is not ours
    if complaint := _complaint(gmsh, path):
        raise InputError(f"gmsh: {complaint}", file=path)
    _set_size(gmsh, size)  # the script may have set its own
    has_mesh = any(len(tags) for tags in gmsh.model.mesh.getElements(2)[1])
    if not has_mesh or size is not None:
        if has_mesh:
            gmsh.model.mesh.clear()
        gmsh.model.mesh.generate(2)
        if complaint := _complaint(gmsh, path):
            raise InputError(f"gmsh: {complaint}", file=path)
    for option, value in {"SaveAll": 1, "MshFileVersion": 4.1, "Binary": 1, "SaveParametric": 0}.items():
        gmsh.option.setNumber(f"Mesh.{option}", value)


def _set_size(gmsh: ModuleType, size: float | None) -> None:
    if size is None:
        return
    for option, value in {"MeshSizeFactor": 1.0, "MeshSizeMin": size, "MeshSizeMax": size}.items():
        gmsh.option.setNumber(f"Mesh.{option}", value)


def _complaint(gmsh: ModuleType, path: Path) -> str:
    """First error gmsh logged, in one line, without the path of the script itself."""
    try:
        lines = gmsh.logger.get()
    except UnicodeDecodeError:  # an error message that quotes the script
        return "the script has an error, in text that is not UTF-8"
    for line in lines:
        if line.startswith("Error"):
            words = " ".join(line.split(":", 1)[1].split())
            return words.replace(f"'{path}', ", "").removesuffix(" ()")
    return ""


@contextmanager
def _session() -> Iterator[ModuleType]:
    """gmsh, quiet, with the user's gmsh configuration ignored; signal handlers are left as they were."""
    handlers = _signal_handlers()  # before the import: gmsh 4.8 resets SIGINT there
    try:
        import gmsh
    except (ImportError, OSError) as error:
        raise InputError(
            f".geo files need gmsh ({error}); install it (apt install python3-gmsh or pip install gmsh) "
            "or give a .msh file"
        ) from None
    try:
        # someone else's session in this process goes on after ours (isInitialized came after gmsh 4.8)
        shared = bool(getattr(gmsh, "isInitialized", lambda: False)())
        if not shared:
            gmsh.initialize(readConfigFiles=False)
        theirs = gmsh.model.getCurrent()
        gmsh.model.add("lyra_petsc")
    except Exception as error:  # its Python module and its library may be of different versions
        raise InputError(f"gmsh does not start ({error}); .geo files need a working gmsh") from None
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("General.Verbosity", 1)  # errors only
        gmsh.option.setNumber("General.AbortOnError", 0)
        yield gmsh
    finally:
        gmsh.logger.stop()
        if shared:
            gmsh.model.remove()
            gmsh.model.setCurrent(theirs)
        else:
            gmsh.finalize()
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _signal_handlers() -> dict[signal.Signals, Any]:
    if threading.current_thread() is not threading.main_thread():
        return {}  # only the main thread may set them
    watched = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)
    return {number: handler for number in watched if (handler := signal.getsignal(number)) is not None}
