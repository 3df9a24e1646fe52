"""Child process in which a library reads one mesh file, or gmsh meshes one script: ``python -m … JOB OUTCOME
MESH``.

A script may loop for ever, ask for more triangles than fit into memory, start programs, or end the process
it runs in; a damaged file may do so to the library that reads it. In a child process this does not end the
simulation; `library_file` starts it and reads its results. Before it reads the file it enters a sandbox
(`gmsh_sandbox`), in which it can open no file for writing: the results go to files that `library_file` has
opened.
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
from lyra_petsc.mesh.library_formats import (
    LIBRARIES,
    FileMesh,
    Refused,
    count_announced,
    read_format,
    refuse_losses,
)
from lyra_petsc.mesh.mesh import ElementBlock

_UNGUARDED = (
    "mesh scripts are programs, and this system has no seccomp to confine them: give --trust-mesh "
    "(Python: trust_mesh=True) if you trust it, or a .msh"
)
_FENCE = " (is it there, in the folder of the script? scripts write no files)"
_SYSTEM = (
    *("/usr", "/lib", "/lib64", "/opt", "/etc/ld.so.cache", "/etc/localtime", "/dev/null", "/dev/urandom"),
    *("/proc/self", "/proc/cpuinfo", "/proc/meminfo", "/proc/stat", "/sys/devices/system"),
)
"""Files and folders that libraries read."""


def main(job: dict[str, Any], outcome: int, mesh: int) -> None:
    """Mesh one script, or read one file.

    Parameters
    ----------
    job : dict
        ``file``, ``script`` (which the file includes; else null), ``readable`` (paths), ``guarded`` (whether
        the sandbox is required), ``size``, ``algorithm`` (or null), ``read_seconds``, ``mesh_seconds``
        (limits on CPU time), ``wall_ratio`` (of the limits on wall time to these), ``memory`` [B],
        ``max_triangles``.
    outcome : int
        Descriptor of a file to which a line of JSON is written for each stage.
    mesh : int
        Descriptor of the file to which the mesh is written (`_write_mesh`).
    """

    def report(**entries: Any) -> None:
        os.write(outcome, json.dumps(entries).encode() + b"\n")

    def enter(library: ModuleType) -> None:
        """Enter the sandbox once the library is loaded."""
        readable = [
            *_SYSTEM,
            sys.prefix,
            sys.base_prefix,
            # may be in other environments; libraries import parts of numpy when they return meshes
            os.path.dirname(library.__file__ or ""),
            os.path.dirname(os.path.dirname(np.__file__)),
            *job["readable"],
        ]
        if "seccomp" not in enter_sandbox(readable) and job["guarded"]:
            raise Refused(_UNGUARDED)

    _set_limits(job["memory"])
    report(stage="read")
    _allow_seconds(job["read_seconds"], job["wall_ratio"])
    try:
        file = Path(job["file"])
        if LIBRARIES[file.suffix] == "gmsh":
            gmsh = _start_gmsh(file.suffix)
            enter(gmsh)
            whole = _read_by_gmsh(gmsh, job, report)
        else:
            whole = read_format(file, enter)
        with open(mesh, "wb", closefd=False) as output:
            _write_mesh(whole, output)
    except Refused as error:
        report(refused=str(error))
    except MemoryError:
        report(stage="memory")
    else:
        report(stage="done")
    os._exit(0)  # nothing of the library outlives the process, so that it need not be finalised


def _read_by_gmsh(gmsh: ModuleType, job: dict[str, Any], report: Callable[..., None]) -> FileMesh:
    """Mesh a script, or read a file of another format."""
    file, script = Path(job["file"]), job["script"]
    if script is None:
        announced = count_announced(file.suffix, file.read_bytes())
        with _raise_refused(gmsh, str(file)):
            gmsh.merge(str(file))
        whole, n_elements = _gmsh_mesh(gmsh), sum(len(tags) for tags in gmsh.model.mesh.getElements()[1])
        refuse_losses("gmsh", announced, len(whole.points), n_elements)
        # elements without a group have the number 0
        grouped = [block._replace(groups=block.groups[block.groups[:, 1] != 0]) for block in whole.elements]
        order = np.argsort(whole.tags)  # gmsh sorts them by entity
        return whole._replace(tags=whole.tags[order], points=whole.points[order], elements=grouped)
    _set_size(gmsh, job["size"])
    with _raise_refused(gmsh, script):
        gmsh.merge(str(file))
        if os.path.exists(f"{script}.opt"):  # gmsh reads it with a file, but not with one that is included
            gmsh.merge(f"{script}.opt")
    report(stage="mesh")
    _allow_seconds(job["mesh_seconds"], job["wall_ratio"])
    _generate_mesh(gmsh, job)
    return _gmsh_mesh(gmsh)


def _set_limits(memory: int) -> None:
    """Limit the memory [B], write no core files, and end with the parent process."""
    _limit(resource.RLIMIT_AS, memory)
    _limit(resource.RLIMIT_CORE, 0)
    with contextlib.suppress(OSError, AttributeError):  # PR_SET_PDEATHSIG, Linux only
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)


def _allow_seconds(seconds: float, wall_ratio: float) -> None:
    """Let the kernel end this process after that much more CPU time (SIGXCPU), or wall time (SIGALRM)."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    _limit(resource.RLIMIT_CPU, math.ceil(used.ru_utime + used.ru_stime + seconds))
    signal.alarm(math.ceil(wall_ratio * seconds))


def _limit(kind: int, value: int) -> None:
    """Set the soft limit on a resource, within its hard limit."""
    hard = resource.getrlimit(kind)[1]
    resource.setrlimit(kind, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))


def _start_gmsh(suffix: str) -> ModuleType:
    """gmsh, initialised without the user's configuration, that prints nothing."""
    try:
        import gmsh
    except (ImportError, OSError) as error:
        raise Refused(
            f"{suffix} files need gmsh ({error}); install it (apt install python3-gmsh or pip install gmsh) "
            "or give a .msh file"
        ) from None
    try:
        gmsh.initialize(readConfigFiles=False)
        gmsh.model.add("lyra_petsc")
    except Exception as error:  # gmsh's Python module and library may be of different versions
        raise Refused(f"gmsh does not start ({error}); {suffix} files need a working gmsh") from None
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.option.setNumber("General.Verbosity", 1)  # errors only
    gmsh.option.setNumber("General.AbortOnError", 0)
    gmsh.logger.start()
    return gmsh


def _generate_mesh(gmsh: ModuleType, job: dict[str, Any]) -> None:
    """Mesh the surfaces."""
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
                _refuse_many_triangles(gmsh, size, maximum)
            gmsh.model.mesh.generate(1)
            if size is None:
                _refuse_many_triangles(gmsh, None, maximum)
            gmsh.model.mesh.generate(2)


def _gmsh_mesh(gmsh: ModuleType) -> FileMesh:
    """The mesh in gmsh, in the order in which gmsh saves it."""
    model = gmsh.model
    tags, points, elements = [np.empty(0, np.int64)], [np.empty((0, 3))], []
    for entity in sorted(model.getEntities()):
        of_entity, coordinates, _ = model.mesh.getNodes(*entity)
        tags.append(np.asarray(of_entity, dtype=np.int64))
        points.append(np.asarray(coordinates, dtype=np.float64).reshape(-1, 3))
        groups = [abs(int(tag)) for tag in model.getPhysicalGroupsForEntity(*entity)]
        kinds, _, nodes = model.mesh.getElements(*entity)
        for kind, of_kind in zip(kinds, nodes, strict=True):
            _, _, _, n_nodes, _, n_corners = model.mesh.getElementProperties(int(kind))
            corners = np.asarray(of_kind, dtype=np.int64).reshape(-1, n_nodes)[:, :n_corners]
            rows = np.column_stack(
                [np.tile(np.arange(len(corners)), len(groups)), np.repeat(groups, len(corners))]
            )
            tag_of_each = np.full(len(corners), entity[1], np.int64)
            elements.append(ElementBlock(int(kind), corners, tag_of_each, rows.astype(np.int64)))
    names = [(int(dim), int(tag), _group_name(gmsh, dim, tag)) for dim, tag in model.getPhysicalGroups()]
    named = [name for name in names if name[2]]
    return FileMesh(np.concatenate(tags), np.concatenate(points), elements, named, [])


def _write_mesh(mesh: FileMesh, file: BinaryIO) -> None:
    """Write a mesh as numpy arrays.

    The first array is a JSON text with ``names`` and ``notes`` of the mesh, and the ``kinds`` of its blocks
    of elements. Then follow the tags and points of the nodes, and the arrays of each block.
    """
    kinds = [block.kind for block in mesh.elements]
    head = json.dumps({"names": mesh.names, "notes": mesh.notes, "kinds": kinds}).encode()
    for array in (np.frombuffer(head, np.uint8), mesh.tags, mesh.points):
        np.save(file, array)
    for block in mesh.elements:
        for array in (block.nodes, block.entity, block.groups):
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


def _refuse_many_triangles(gmsh: ModuleType, size: float | None, maximum: int) -> None:
    """Refuse a mesh that cannot fit into memory, by the areas of bounding boxes and the element size; without
    ``size`` by that of boundary edges.
    """
    count = 0.0
    for dimension, tag in gmsh.model.getEntities(2):
        edge = _longest_mean_edge(gmsh, tag) if size is None else size
        if edge is not None:
            x, y, z = _extent(gmsh.model.getBoundingBox(dimension, tag))
            # a quarter of those that fill the box, which a surface may hardly do
            count += 0.5 * math.hypot(x * y, y * z, z * x) / edge**2
    if count > maximum:
        cause = "the sizes in the script" if size is None else f"size {size:g} m"
        raise Refused(
            f"{cause} would give about {count:.2g} triangles; at most {maximum:.2g} fit into memory"
        )


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
    raised = []
    try:
        yield
    except (Refused, MemoryError):
        raise
    except Exception as error:  # gmsh raises nothing more precise
        raised.append(str(error))
    try:
        logged = [line.split(":", 1)[1] for line in gmsh.logger.get() if line.startswith("Error")]
    except UnicodeDecodeError:  # an error message that quotes the script
        logged = ["the script has an error, in text that is not UTF-8"]
    for text in logged + raised:
        message = " ".join(text.split()).replace(f"'{script}', ", "").removesuffix(" ()")
        hint = _FENCE if "Unable to open file" in message else ""
        raise Refused(f"gmsh: {message.replace(os.path.dirname(script) + '/', '')}{hint}")


if __name__ == "__main__":
    main(json.loads(Path(sys.argv[1]).read_text()), int(sys.argv[2]), int(sys.argv[3]))
