"""The verb ``info``: versions and configuration of the installation, incompatible parts, and remedies."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import platform
import socket
import sys
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lyra_petsc import __version__
from lyra_petsc.mesh.gmsh_sandbox import describe_sandbox, supported_layers

OLDEST_PETSC = (3, 18)


@dataclass
class Installation:
    """Facts about the installation and the MPI job; ``None`` for a missing part."""

    ranks: int = 1
    launched: int = 1
    """Ranks that the launcher started, by its environment variables."""
    ranks_per_host: dict[str, int] = field(default_factory=dict)
    cores: int = 1
    """Cores of the host of rank 0."""
    threads: str = ""
    """Value of OMP_NUM_THREADS; empty if unset."""
    petsc: tuple[int, ...] | None = None
    complex_scalars: bool = False
    mpi_libraries: tuple[str, ...] = ()
    """Files of the loaded MPI libraries."""
    missing: list[str] = field(default_factory=list)
    broken: dict[str, str] = field(default_factory=dict)


def incompatibilities(found: Installation) -> list[str]:
    """One line for each problem, with its remedy."""
    lines = [f"{name} is missing: {_source(name)}." for name in found.missing]
    lines += [f"{name} is there but fails: {error}." for name, error in found.broken.items()]
    if found.ranks < found.launched:
        lines.append(
            f"The launcher started {found.launched} ranks but each of them sees {found.ranks}: mpi4py was "
            "built with another MPI. Use the mpirun (or srun --mpi=…) of the MPI named above, or rebuild "
            "mpi4py and petsc4py with the launcher's."
        )
    if len(found.mpi_libraries) > 1:
        lines.append(
            f"Two MPI libraries are loaded at once ({', '.join(found.mpi_libraries)}): mpi4py, petsc4py and "
            "h5py must be built with the same one."
        )
    if found.petsc is not None and found.petsc[:2] < OLDEST_PETSC:
        version, oldest = ".".join(map(str, found.petsc)), ".".join(map(str, OLDEST_PETSC))
        lines.append(f"PETSc {version} is too old: {oldest} or newer is needed.")
    if found.complex_scalars:
        lines.append(
            "PETSc was built with complex scalars: use a real build (Debian: python3-petsc4py-real; "
            'conda-forge: "petsc=*=real*").'
        )
    threads = int(found.threads) if found.threads.isdigit() else 1
    ranks = max(found.ranks_per_host.values(), default=1)
    if threads > 1 and threads * ranks > found.cores:
        lines.append(
            f"OMP_NUM_THREADS={threads} on {ranks} ranks asks for more than the {found.cores} cores of a "
            "host: set OMP_NUM_THREADS=1, the ranks are the parallelism."
        )
    return lines


def _source(name: str) -> str:
    if name in ("mpi4py", "PETSc", "h5py", "gmsh"):
        return "install it from the distribution, conda-forge or the cluster's modules (see README.md)"
    if name.startswith("PETSc "):
        return "it comes with petsc4py"
    return f"pip install {name}"


EXTERNAL = ("ptscotch", "parmetis", "hypre", "ml", "mumps", "superlu_dist", "suitesparse", "hdf5")
"""Optional packages of PETSc that are relevant here (suitesparse contains CHOLMOD)."""


def info(comm: Any) -> str:
    """Versions, configuration and incompatibilities as text; collective.

    Returns
    -------
    str
        Several lines, the same on every rank, in which missing and broken parts are marked.
    """
    hosts = comm.allgather(socket.gethostname())
    facts = Installation(
        ranks=comm.size,
        launched=launched_ranks(os.environ),
        ranks_per_host=dict(Counter(hosts)),
        cores=os.cpu_count() or 1,
        threads=os.environ.get("OMP_NUM_THREADS", ""),
    )
    lines = [
        ("lyra_petsc", f"{__version__} in {Path(__file__).resolve().parents[1]}"),
        ("Python", f"{platform.python_version()} at {sys.executable}"),
        ("system", f"{platform.system()} {platform.release()}, {platform.machine()}, {facts.cores} cores"),
    ]
    for name, describe in PARTS.items():
        lines.append((name, _described(name, describe, facts)))
    if comm.rank == 0:
        lines.append(("gmsh's sandbox", describe_sandbox(supported_layers())))
    facts.mpi_libraries = loaded_mpi_libraries()
    ranks = ", ".join(f"{count} on {host}" for host, count in facts.ranks_per_host.items())
    lines.append(("ranks", ranks))
    width = max(len(name) for name, _ in lines)
    text = [f"{name:<{width}}  {value}" for name, value in lines]
    problems = incompatibilities(facts)
    text.append("")
    text += (
        ["What does not fit together:", *(f"- {problem}" for problem in problems)]
        if problems
        else ["All fits together."]
    )
    # rank 0 decides: h5py and the libraries are the same files on every rank
    return comm.bcast("\n".join(text), root=0)


def launched_ranks(environment: Mapping[str, str]) -> int:
    """Number of ranks that the launcher started, by its environment variables; 1 without a launcher."""
    for name in ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "MPI_LOCALNRANKS"):
        if environment.get(name, "").isdigit():
            return int(environment[name])
    # only within srun: the batch script, a single process, has SLURM_NTASKS as well
    if environment.get("SLURM_STEP_NUM_TASKS", "").isdigit() and "SLURM_PROCID" in environment:
        return int(environment["SLURM_STEP_NUM_TASKS"])
    return 1


def loaded_mpi_libraries() -> tuple[str, ...]:
    """Files of the MPI libraries loaded in this process; empty on systems without /proc."""
    try:
        maps = Path("/proc/self/maps").read_text(errors="replace")
    except OSError:
        return ()
    files = {line.split(maxsplit=5)[5] for line in maps.splitlines() if len(line.split(maxsplit=5)) == 6}
    names = ("libmpi.so", "libmpich.so", "libmpi_cray.so", "libmpi_gnu")
    return tuple(sorted(file for file in files if Path(file).name.startswith(names)))


def _described(name: str, describe: Callable[[Installation], str], facts: Installation) -> str:
    try:
        return describe(facts)
    except ModuleNotFoundError:
        facts.missing.append(name)
        return "missing"
    except Exception as error:  # a broken library may raise anything, and this verb must report it
        facts.broken[name] = " ".join(str(error).split()) or type(error).__name__
        return "broken"


def _module_version(name: str) -> Callable[[Installation], str]:
    def describe(facts: Installation) -> str:
        module = importlib.import_module(name)
        return str(getattr(module, "__version__", None) or importlib.metadata.version(name))

    return describe


def _mpi(facts: Installation) -> str:
    import mpi4py
    from mpi4py import MPI

    library = MPI.Get_library_version().split("\n")[0].split(",")[0].strip("\0 ")
    standard = ".".join(map(str, MPI.Get_version()))
    return f"{mpi4py.__version__} with {library} (MPI {standard})"


def _petsc(facts: Installation) -> str:
    import petsc4py
    from petsc4py import PETSc

    facts.petsc = PETSc.Sys.getVersion()
    facts.complex_scalars = PETSc.ScalarType().dtype.kind == "c"
    scalar, index = PETSc.ScalarType().dtype.name, PETSc.IntType().dtype.name
    version = ".".join(map(str, facts.petsc))
    text = f"{version} (petsc4py {petsc4py.__version__}), {scalar} scalars, {index} indices"
    debugging = _petsc_debugging(petsc4py.get_config())
    if debugging is not None:
        text += ", with debugging (slow)" if debugging else ", optimised"
    return text


def _petsc_debugging(config: Mapping[str, str]) -> bool | None:
    """Whether PETSc was built with debugging; ``None`` if its headers are not installed."""
    header = Path(config.get("PETSC_DIR", ""), config.get("PETSC_ARCH", ""), "include", "petscconf.h")
    try:
        return "#define PETSC_USE_DEBUG 1" in header.read_text(errors="replace")
    except OSError:
        return None


def _petsc_folder(facts: Installation) -> str:
    import petsc4py

    config = petsc4py.get_config()
    return os.path.join(config.get("PETSC_DIR", ""), config.get("PETSC_ARCH", "")).rstrip("/") or "not known"


def _petsc_packages(facts: Installation) -> str:
    from petsc4py import PETSc

    present = [name for name in EXTERNAL if PETSc.Sys.hasExternalPackage(name)]
    absent = [name for name in EXTERNAL if name not in present]
    return f"{', '.join(present) or 'none'}; not: {', '.join(absent) or 'none'}"


def _h5py(facts: Installation) -> str:
    import h5py

    kind = "parallel" if h5py.get_config().mpi else "serial"
    return f"{h5py.__version__} with HDF5 {h5py.version.hdf5_version}, {kind}"


PARTS: dict[str, Callable[[Installation], str]] = {
    "mpi4py": _mpi,
    "PETSc": _petsc,
    "PETSc folder": _petsc_folder,
    "PETSc packages": _petsc_packages,
    "h5py": _h5py,
    "gmsh": _module_version("gmsh"),
    "numpy": _module_version("numpy"),
    "numba": _module_version("numba"),
    "pydantic": _module_version("pydantic"),
    "ruamel.yaml": _module_version("ruamel.yaml"),
}
"""The parts to describe, in this order; each function may also set facts."""
