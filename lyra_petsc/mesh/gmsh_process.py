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
_SHARE_OF_BOX = 0.25
"""What a surface fills of its bounding box at least, for the estimate of its triangles."""

_SYSTEM = (
    *("/usr", "/lib", "/lib64", "/opt", "/etc/ld.so.cache", "/etc/localtime", "/dev/null", "/dev/urandom"),
    *("/proc/self", "/proc/cpuinfo", "/proc/meminfo", "/proc/stat", "/sys/devices/system"),
)
"""What libraries may read when they are in use."""


class Refused(Exception):
    """The script cannot be used; the message is for the user."""


def main(job: dict[str, Any], outcome: int, mesh: int) -> None:
    """Do a job.

    Parameters
    ----------
    job : dict
        ``script``, ``folder`` (what may be read; null: all), ``size`` (or null), ``algorithm`` (or null),
        ``script_seconds``, ``mesh_seconds`` (CPU time), ``memory`` [B] and ``most_triangles``.
    outcome : int
        Descriptor of a file that gets a line of JSON for each stage.
    mesh : int
        Descriptor of the file that gets the mesh (`_write_mesh`).
    """

    def report(**words: Any) -> None:
        os.write(outcome, json.dumps(words).encode() + b"\n")

    _confine(job["memory"])
    report(stage="script")
    _allow_seconds(job["script_seconds"])
    try:
        with _session() as gmsh, open(mesh, "wb", closefd=False) as file:
            readable = [
                *_SYSTEM,
                sys.prefix,
                sys.base_prefix,
                # other environments may hold these; gmsh reads parts of numpy when it hands over meshes
                os.path.dirname(gmsh.__file__ or ""),
                os.path.dirname(os.path.dirname(np.__file__)),
                job["folder"],
            ]
            report(sandbox=enter_sandbox(None if job["folder"] is None else readable))
            _set_size(gmsh, job["size"])
            with _errors_told(gmsh, job["script"]):
                gmsh.merge(job["script"])
            report(stage="mesh")
            _allow_seconds(job["mesh_seconds"])
            _mesh(gmsh, job, lambda count: report(triangles=round(count)))
            _write_mesh(gmsh, file)
    except Refused as error:
        report(refused=str(error))
    except MemoryError:
        report(stage="memory")
    else:
        report(stage="done")
    os._exit(0)  # gmsh has nothing to put away that outlives the process


def _confine(memory: int) -> None:
    _limit(resource.RLIMIT_AS, memory)
    _limit(resource.RLIMIT_CORE, 0)
    with contextlib.suppress(OSError, AttributeError):  # Linux: end together with who started us
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)


def _allow_seconds(seconds: float) -> None:
    """Let the kernel end this process (SIGXCPU) after that much more CPU time."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    _limit(resource.RLIMIT_CPU, math.ceil(used.ru_utime + used.ru_stime + seconds))


def _limit(what: int, value: int) -> None:
    """Set a soft limit, within the hard one that stands."""
    hard = resource.getrlimit(what)[1]
    resource.setrlimit(what, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))


@contextmanager
def _session() -> Iterator[ModuleType]:
    """gmsh, quiet, with the user's gmsh configuration ignored."""
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
    except Exception as error:  # its Python module and its library may be of different versions
        raise Refused(f"gmsh does not start ({error}); .geo files need a working gmsh") from None
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.option.setNumber("General.Verbosity", 1)  # errors only
    gmsh.option.setNumber("General.AbortOnError", 0)
    gmsh.logger.start()
    yield gmsh


def _mesh(gmsh: ModuleType, job: dict[str, Any], expect: Callable[[float], None]) -> None:
    script, size, most = job["script"], job["size"], job["most_triangles"]
    _set_size(gmsh, size)  # the script may have set its own
    if job["algorithm"] is not None:
        gmsh.option.setNumber("Mesh.Algorithm", job["algorithm"])
    has_mesh = any(len(tags) for tags in gmsh.model.mesh.getElements(2)[1])
    with _errors_told(gmsh, script):
        if not has_mesh or size is not None or job["algorithm"] is not None:
            if has_mesh:
                gmsh.model.mesh.clear()
            if size is not None:
                _refuse_many(_curve_length(gmsh) / size, "edges", size, most)
                _refuse_many(_estimate(gmsh, size), "triangles", size, most)
            gmsh.model.mesh.generate(1)
            count = _estimate(gmsh, size)
            if size is None:
                _refuse_many(count, "triangles", None, most)
            expect(count / _SHARE_OF_BOX)  # of flat sheets that fill their boxes
            gmsh.model.mesh.generate(2)


def _write_mesh(gmsh: ModuleType, file: BinaryIO) -> None:
    """Write nodes, elements up to surfaces and groups, as gmsh orders them in a file, as numpy arrays.

    First a JSON text: ``names`` as rows (dimension, tag, name) of physical groups, and ``blocks`` as rows
    (element type, entity, tags of its groups). Then the tags (n,) and points (n, 3) of the nodes, and the
    corners (m, corners) of each block's elements.
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
    """Name of a physical group, whatever its encoding: gmsh's own Python raises for what is not UTF-8."""
    name, error = ctypes.c_char_p(), ctypes.c_int()
    gmsh.lib.gmshModelGetPhysicalName(
        ctypes.c_int(dimension), ctypes.c_int(tag), ctypes.byref(name), ctypes.byref(error)
    )
    return (name.value or b"").decode("utf-8", errors="replace")


def _set_size(gmsh: ModuleType, size: float | None) -> None:
    if size is None:
        return
    for option, value in {"MeshSizeFactor": 1.0, "MeshSizeMin": size, "MeshSizeMax": size}.items():
        gmsh.option.setNumber(f"Mesh.{option}", value)


def _refuse_many(number: float, what: str, size: float | None, most: int) -> None:
    if number > most:
        where = "the sizes in the script" if size is None else f"size {size:g} m"
        raise Refused(f"{where} would give about {number:.2g} {what}; at most {most:.2g} fit into memory")


def _curve_length(gmsh: ModuleType) -> float:
    """Sum [m] of the straight distances that the curves span."""
    boxes = (gmsh.model.getBoundingBox(*entity) for entity in gmsh.model.getEntities(1))
    return sum(math.hypot(*_extent(box)) for box in boxes)


def _estimate(gmsh: ModuleType, size: float | None) -> float:
    """Triangles of all surfaces, from their bounding boxes; without ``size`` from the edges around them."""
    count = 0.0
    for dimension, tag in gmsh.model.getEntities(2):
        edge = _longest_mean_edge(gmsh, tag) if size is None else size
        if edge is None:
            continue
        x, y, z = _extent(gmsh.model.getBoundingBox(dimension, tag))
        count += _SHARE_OF_BOX * math.hypot(x * y, y * z, z * x) / (_EQUILATERAL * edge * edge)
    return count


def _longest_mean_edge(gmsh: ModuleType, surface: int) -> float | None:
    """Mean length [m] of the edges on the most coarsely divided curve around a surface."""
    means = []
    for dimension, curve in gmsh.model.getBoundary([(2, surface)], oriented=False):
        edges = sum(len(tags) for tags in gmsh.model.mesh.getElements(dimension, curve)[1])
        span = math.hypot(*_extent(gmsh.model.getBoundingBox(dimension, curve)))
        if edges and span > 0.0:
            means.append(span / edges)
    return max(means, default=None)


def _extent(box: tuple[float, ...]) -> tuple[float, float, float]:
    sides = [high - low for low, high in zip(box[:3], box[3:], strict=True)]
    x, y, z = (side if 0.0 <= side < 1e100 else 0.0 for side in sides)
    return x, y, z


@contextmanager
def _errors_told(gmsh: ModuleType, script: str) -> Iterator[None]:
    """Turn what gmsh raises, or only logs, into `Refused`."""
    try:
        yield
    except (Refused, MemoryError):
        raise
    except Exception as error:  # gmsh raises nothing more precise
        raise Refused(f"gmsh: {_complaint(gmsh, script) or ' '.join(str(error).split())}") from None
    if complaint := _complaint(gmsh, script):
        raise Refused(f"gmsh: {complaint}")


def _complaint(gmsh: ModuleType, script: str) -> str:
    """First error gmsh logged, in one line, without the path of the script itself."""
    try:
        lines = gmsh.logger.get()
    except UnicodeDecodeError:  # an error message that quotes the script
        return "the script has an error, in text that is not UTF-8"
    for line in lines:
        if line.startswith("Error"):
            words = " ".join(line.split(":", 1)[1].split())
            folder = os.path.dirname(script)  # of copies: the user knows the files by other names
            return words.replace(f"'{script}', ", "").replace(f"{folder}/", "").removesuffix(" ()")
    return ""


if __name__ == "__main__":
    main(json.loads(Path(sys.argv[1]).read_text()), int(sys.argv[2]), int(sys.argv[3]))
