"""Child process in which gmsh meshes one script: ``python -m … JOB OUTCOME MESH``.

A script may loop for ever, ask for more triangles than fit into memory, or end the process it runs in. In
a child process this does not end the simulation; `geo_file` starts it and reads its results. Before it reads
the script it enters a sandbox (`gmsh_sandbox`), in which it can open no file for writing: the results go to
files that `geo_file` has opened.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import math
import os
import resource
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO

import numpy as np

from lyra_petsc.mesh.gmsh_sandbox import enter_sandbox

_EQUILATERAL = math.sqrt(3) / 4
_MIN_FILL = 0.25
"""Fraction of its bounding box that a surface fills at least, for estimates of the number of triangles."""

_SYSTEM = (
    *("/usr", "/lib", "/lib64", "/opt", "/etc/ld.so.cache", "/etc/localtime", "/dev/null", "/dev/urandom"),
    *("/proc/self", "/proc/cpuinfo", "/proc/meminfo", "/proc/stat", "/sys/devices/system"),
)
"""Files and folders that libraries read."""


class Refused(Exception):
    """The script cannot be used; the message is for the user."""


def main(job: dict[str, Any], outcome: int, mesh: int) -> None:
    """Mesh one script.

    Parameters
    ----------
    job : dict
        ``script``, ``folder`` (may be read; null: all may), ``size`` (or null), ``algorithm`` (or null),
        ``script_seconds``, ``mesh_seconds`` (limits on CPU time), ``memory`` [B] and ``max_triangles``.
    outcome : int
        Descriptor of a file to which a line of JSON is written for each stage.
    mesh : int
        Descriptor of the file to which the mesh is written (`_write_mesh`).
    """

    def report(**entries: Any) -> None:
        os.write(outcome, json.dumps(entries).encode() + b"\n")

    _set_limits(job["memory"])
    report(stage="script")
    _allow_seconds(job["script_seconds"])
    try:
        with _session() as gmsh, open(mesh, "wb", closefd=False) as file:
            readable = [
                *_SYSTEM,
                sys.prefix,
                sys.base_prefix,
                # may be in other environments; gmsh imports parts of numpy when it returns meshes
                os.path.dirname(gmsh.__file__ or ""),
                os.path.dirname(os.path.dirname(np.__file__)),
                job["folder"],
            ]
            report(sandbox=enter_sandbox(None if job["folder"] is None else readable))
            _set_size(gmsh, job["size"])
            with _raise_refused(gmsh, job["script"]):
                gmsh.merge(job["script"])
            report(stage="mesh")
            _allow_seconds(job["mesh_seconds"])
            _generate_mesh(gmsh, job, lambda count: report(triangles=round(count)))
            _write_mesh(gmsh, file)
    except Refused as error:
        report(refused=str(error))
    except MemoryError:
        report(stage="memory")
    else:
        report(stage="done")
    os._exit(0)  # nothing of gmsh outlives the process, so that it need not be finalised


def _set_limits(memory: int) -> None:
    """Limit the memory [B], write no core files, and end with the parent process."""
    _limit(resource.RLIMIT_AS, memory)
    _limit(resource.RLIMIT_CORE, 0)
    with contextlib.suppress(OSError, AttributeError):  # PR_SET_PDEATHSIG, Linux only
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)


def _allow_seconds(seconds: float) -> None:
    """Let the kernel end this process (SIGXCPU) after that much more CPU time."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    _limit(resource.RLIMIT_CPU, math.ceil(used.ru_utime + used.ru_stime + seconds))


def _limit(kind: int, value: int) -> None:
    """Set the soft limit on a resource, within its hard limit."""
    hard = resource.getrlimit(kind)[1]
    resource.setrlimit(kind, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))


@contextmanager
def _session() -> Iterator[ModuleType]:
    """gmsh, initialised without the user's configuration, that prints nothing."""
    try:
        import gmsh
    except (ImportError, OSError) as error:
        raise Refused(
            f".geo files need gmsh ({error}); install it (apt install python3-gmsh or pip install gmsh) "
            "or give a .msh file"
        ) from None
    try:
        gmsh.initialize(readConfigFiles=False)
        gmsh.model.add("lyra_petsc")
    except Exception as error:  # gmsh's Python module and library may be of different versions
        raise Refused(f"gmsh does not start ({error}); .geo files need a working gmsh") from None
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.option.setNumber("General.Verbosity", 1)  # errors only
    gmsh.option.setNumber("General.AbortOnError", 0)
    gmsh.logger.start()
    yield gmsh


def _generate_mesh(gmsh: ModuleType, job: dict[str, Any], expect: Callable[[float], None]) -> None:
    """Mesh the surfaces; ``expect`` is called with an estimate of the number of triangles."""
    script, size, maximum = job["script"], job["size"], job["max_triangles"]
    _set_size(gmsh, size)  # the script may have set its own
    if job["algorithm"] is not None:
        gmsh.option.setNumber("Mesh.Algorithm", job["algorithm"])
    has_mesh = any(len(tags) for tags in gmsh.model.mesh.getElements(2)[1])
    with _raise_refused(gmsh, script):
        if not has_mesh or size is not None or job["algorithm"] is not None:
            if has_mesh:
                gmsh.model.mesh.clear()
            if size is not None:
                _refuse_many(_curve_length(gmsh) / size, "edges", size, maximum)
                _refuse_many(_estimate_triangles(gmsh, size), "triangles", size, maximum)
            gmsh.model.mesh.generate(1)
            count = _estimate_triangles(gmsh, size)
            if size is None:
                _refuse_many(count, "triangles", None, maximum)
            expect(count / _MIN_FILL)  # for flat sheets, which fill their boxes
            gmsh.model.mesh.generate(2)


def _write_mesh(gmsh: ModuleType, file: BinaryIO) -> None:
    """Write nodes, elements and physical groups as numpy arrays, in the order in which gmsh saves them.

    The first array is a JSON text: ``names`` has rows (dimension, tag, name) of physical groups, ``blocks``
    rows (element type, entity, tags of its groups). Then follow the tags (n,) and points (n, 3) of the nodes,
    and for each block the corners (m, corners) of its elements.
    """
    model = gmsh.model
    entities = sorted(model.getEntities())
    tags, points, blocks, corners = [], [], [], []
    for entity in entities:
        found, coordinates, _ = model.mesh.getNodes(*entity)
        tags.append(np.asarray(found, dtype=np.int64))
        points.append(np.asarray(coordinates, dtype=np.float64).reshape(-1, 3))
        groups = [abs(int(tag)) for tag in model.getPhysicalGroupsForEntity(*entity)]
        kinds, _, nodes = model.mesh.getElements(*entity)
        for kind, of_kind in zip(kinds, nodes, strict=True):
            _, _, _, each, _, primary = model.mesh.getElementProperties(int(kind))
            blocks.append((int(kind), int(entity[1]), groups))
            corners.append(np.asarray(of_kind, dtype=np.int64).reshape(-1, each)[:, :primary])
    names = [(*map(int, group), _group_name(gmsh, *group)) for group in model.getPhysicalGroups()]
    head = json.dumps({"names": [name for name in names if name[2]], "blocks": blocks}).encode()
    all_tags = np.concatenate([np.empty(0, np.int64), *tags])
    all_points = np.concatenate([np.empty((0, 3)), *points])
    for array in (np.frombuffer(head, np.uint8), all_tags, all_points, *corners):
        np.save(file, array)
    file.flush()


def _group_name(gmsh: ModuleType, dimension: int, tag: int) -> str:
    """Name of a physical group in any encoding; gmsh's Python module raises for names not in UTF-8."""
    name, error = ctypes.c_char_p(), ctypes.c_int()
    gmsh.lib.gmshModelGetPhysicalName(
        ctypes.c_int(dimension), ctypes.c_int(tag), ctypes.byref(name), ctypes.byref(error)
    )
    return (name.value or b"").decode("utf-8", errors="replace")


def _set_size(gmsh: ModuleType, size: float | None) -> None:
    """Replace all element sizes by ``size``; None keeps them."""
    if size is None:
        return
    for option, value in {"MeshSizeFactor": 1.0, "MeshSizeMin": size, "MeshSizeMax": size}.items():
        gmsh.option.setNumber(f"Mesh.{option}", value)


def _refuse_many(number: float, kind: str, size: float | None, maximum: int) -> None:
    if number > maximum:
        cause = "the sizes in the script" if size is None else f"size {size:g} m"
        raise Refused(f"{cause} would give about {number:.2g} {kind}; at most {maximum:.2g} fit into memory")


def _curve_length(gmsh: ModuleType) -> float:
    """Lower bound [m] of the length of all curves: the sum of the diagonals of their bounding boxes."""
    boxes = (gmsh.model.getBoundingBox(*entity) for entity in gmsh.model.getEntities(1))
    return sum(math.hypot(*_extent(box)) for box in boxes)


def _estimate_triangles(gmsh: ModuleType, size: float | None) -> float:
    """Number of triangles by bounding boxes and element size; without ``size`` by that of boundary edges."""
    count = 0.0
    for dimension, tag in gmsh.model.getEntities(2):
        edge = _longest_mean_edge(gmsh, tag) if size is None else size
        if edge is None:
            continue
        x, y, z = _extent(gmsh.model.getBoundingBox(dimension, tag))
        count += _MIN_FILL * math.hypot(x * y, y * z, z * x) / (_EQUILATERAL * edge * edge)
    return count


def _longest_mean_edge(gmsh: ModuleType, surface: int) -> float | None:
    """Mean length [m] of the edges on the coarsest boundary curve of a surface; None without edges."""
    means = []
    for dimension, curve in gmsh.model.getBoundary([(2, surface)], oriented=False):
        edges = sum(len(tags) for tags in gmsh.model.mesh.getElements(dimension, curve)[1])
        span = math.hypot(*_extent(gmsh.model.getBoundingBox(dimension, curve)))
        if edges and span > 0.0:
            means.append(span / edges)
    return max(means, default=None)


def _extent(box: tuple[float, ...]) -> tuple[float, float, float]:
    """Sides [m] of a bounding box of gmsh; 0 for sides without limit."""
    sides = [high - low for low, high in zip(box[:3], box[3:], strict=True)]
    x, y, z = (side if 0.0 <= side < 1e100 else 0.0 for side in sides)
    return x, y, z


@contextmanager
def _raise_refused(gmsh: ModuleType, script: str) -> Iterator[None]:
    """Raise `Refused` for errors that gmsh raises or only logs."""
    try:
        yield
    except (Refused, MemoryError):
        raise
    except Exception as error:  # gmsh raises nothing more precise
        raise Refused(f"gmsh: {_logged_error(gmsh, script) or ' '.join(str(error).split())}") from None
    if message := _logged_error(gmsh, script):
        raise Refused(f"gmsh: {message}")


def _logged_error(gmsh: ModuleType, script: str) -> str:
    """The first error in gmsh's log, on one line and without the path of the script; empty if none."""
    try:
        lines = gmsh.logger.get()
    except UnicodeDecodeError:  # an error message that quotes the script
        return "the script has an error, in text that is not UTF-8"
    for line in lines:
        if line.startswith("Error"):
            message = " ".join(line.split(":", 1)[1].split())
            folder = os.path.dirname(script)  # holds copies, whose paths mean nothing to the user
            return message.replace(f"'{script}', ", "").replace(f"{folder}/", "").removesuffix(" ()")
    return ""


if __name__ == "__main__":
    main(json.loads(Path(sys.argv[1]).read_text()), int(sys.argv[2]), int(sys.argv[3]))
