"""A process of its own for gmsh: ``python -m lyra_petsc.mesh.gmsh_process JOB`` meshes one script.

A script may loop for ever, ask for more triangles than there is memory, or end the process it runs in.
Here that ends this process and not the simulation; ``geo_file`` starts it and reads the outcome.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import math
import resource
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

_EQUILATERAL = math.sqrt(3) / 4
_SHARE_OF_BOX = 0.25
"""What a surface fills of its bounding box at least, for the estimate of its triangles."""


class Refused(Exception):
    """The script cannot be used; the message is for the user."""


def main(job_file: Path) -> None:
    """Do the job described by a JSON file, and write ``outcome.json`` beside it.

    The job holds ``script``, ``size`` (or null), ``mesh`` (the file to write), ``script_seconds``,
    ``mesh_seconds`` (CPU time), ``memory`` [B] and ``most_triangles``.
    """
    job = json.loads(job_file.read_text())
    outcome = job_file.with_name("outcome.json")

    def tell(**words: str) -> None:
        outcome.write_text(json.dumps(words))

    _confine(job["memory"])
    tell(stage="script")
    _allow_seconds(job["script_seconds"])
    try:
        with _session() as gmsh:
            _run_script(gmsh, job["script"], job["size"])
            tell(stage="mesh")
            _allow_seconds(job["mesh_seconds"])
            _mesh(gmsh, job)
            gmsh.write(job["mesh"])
    except Refused as error:
        tell(refused=str(error))
    except MemoryError:
        tell(stage="memory")
    else:
        tell(stage="done")


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
    try:
        yield gmsh
    finally:
        gmsh.logger.stop()
        gmsh.finalize()


def _run_script(gmsh: ModuleType, script: str, size: float | None) -> None:
    gmsh.logger.start()
    _set_size(gmsh, size)
    with _errors_told(gmsh, script):
        gmsh.merge(script)


def _mesh(gmsh: ModuleType, job: dict[str, Any]) -> None:
    script, size, most = job["script"], job["size"], job["most_triangles"]
    _set_size(gmsh, size)  # the script may have set its own
    has_mesh = any(len(tags) for tags in gmsh.model.mesh.getElements(2)[1])
    with _errors_told(gmsh, script):
        if not has_mesh or size is not None:
            if has_mesh:
                gmsh.model.mesh.clear()
            if size is not None:
                _refuse_many(_curve_length(gmsh) / size, "edges", size, most)
                _refuse_many(_estimate(gmsh, size), "triangles", size, most)
            gmsh.model.mesh.generate(1)
            if size is None:
                _refuse_many(_estimate(gmsh, None), "triangles", None, most)
            gmsh.model.mesh.generate(2)
    for option, value in {"SaveAll": 1, "MshFileVersion": 4.1, "Binary": 1, "SaveParametric": 0}.items():
        gmsh.option.setNumber(f"Mesh.{option}", value)


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
    return sum(math.dist(box[:3], box[3:]) for box in _boxes(gmsh, 1))


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


def _boxes(gmsh: ModuleType, dimension: int) -> Iterator[tuple[float, ...]]:
    for entity in gmsh.model.getEntities(dimension):
        box = gmsh.model.getBoundingBox(*entity)
        if all(math.isfinite(value) and abs(value) < 1e100 for value in box):
            yield box


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
            return words.replace(f"'{script}', ", "").removesuffix(" ()")
    return ""


if __name__ == "__main__":
    main(Path(sys.argv[1]))
