"""The verb ``info``: versions and configuration of the installation, incompatible parts, and remedies."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import platform
import re
import socket
import sys
from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from lyra_petsc import __version__
from lyra_petsc.mesh.gmsh_sandbox import describe_sandbox, supported_layers

OLDEST_PETSC = (3, 18)

Problems = list[str]
"""One line for each part that does not fit, with its remedy."""

EXTERNAL = ("ptscotch", "parmetis", "hypre", "ml", "mumps", "superlu_dist", "suitesparse", "hdf5")
"""Optional packages of PETSc that are relevant here (suitesparse contains CHOLMOD)."""


def info(comm: Any) -> str:
    """Versions, configuration and incompatibilities as text; collective.

    Returns
    -------
    str
        Several lines, the same on every rank, in which missing and broken parts are marked.
    """
    hosts = Counter(comm.allgather(socket.gethostname()))
    cores, problems = os.cpu_count() or 1, Problems()
    lines = {
        "lyra_petsc": f"{__version__} in {Path(__file__).resolve().parents[1]}",
        "Python": f"{platform.python_version()} at {sys.executable}",
        "system": f"{platform.system()} {platform.release()}, {platform.machine()}, {cores} cores",
    }
    lines |= {name: _described(name, describe, problems) for name, describe in PARTS.items()}
    if comm.rank == 0:
        lines["gmsh's sandbox"] = describe_sandbox(supported_layers())
    lines["ranks"] = ", ".join(f"{count} on {host}" for host, count in hosts.items())
    problems += rank_problems(os.environ, comm.size, max(hosts.values()), cores)
    if len(libraries := loaded_mpi_libraries()) > 1:
        problems.append(
            f"Two MPI libraries are loaded at once ({', '.join(libraries)}): mpi4py, petsc4py and h5py must "
            "be built with the same one."
        )
    width = max(map(len, lines))
    text = [*(f"{name:<{width}}  {value}" for name, value in lines.items()), ""]
    text.append("What does not fit together:" if problems else "All fits together.")
    # rank 0 decides: h5py and the libraries are the same files on every rank
    return str(comm.bcast("\n".join([*text, *(f"- {problem}" for problem in problems)]), root=0))


def rank_problems(environment: Mapping[str, str], ranks: int, ranks_here: int, cores: int) -> Problems:
    """What is wrong with the number of ranks, and of their threads.

    Parameters
    ----------
    environment : mapping
    ranks, ranks_here : int
        Ranks of the job, and most ranks of a machine.
    cores : int
        Cores of a machine.
    """
    problems = Problems()
    # srun's only within srun: the batch script, a single process, has SLURM_NTASKS as well
    names = ["OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "MPI_LOCALNRANKS"]
    names += ["SLURM_STEP_NUM_TASKS"] if "SLURM_PROCID" in environment else []
    launched = [int(number) for name in names if (number := environment.get(name, "")).isdigit()]
    if launched and ranks < launched[0]:
        problems.append(
            f"The launcher started {launched[0]} ranks but each of them sees {ranks}: mpi4py was built with "
            "another MPI. Use the mpirun (or srun --mpi=…) of the MPI named above, or rebuild mpi4py and "
            "petsc4py with the launcher's."
        )
    threads = environment.get("OMP_NUM_THREADS", "")
    if threads.isdigit() and int(threads) > 1 and int(threads) * ranks_here > cores:
        problems.append(
            f"OMP_NUM_THREADS={threads} on {ranks_here} ranks asks for more than the {cores} cores of a "
            "host: set OMP_NUM_THREADS=1, the ranks are the parallelism."
        )
    return problems


def loaded_mpi_libraries() -> list[str]:
    """Files of the MPI libraries loaded in this process; empty on systems without /proc."""
    try:
        maps = Path("/proc/self/maps").read_text(errors="replace")
    except OSError:
        return []
    return sorted(set(re.findall(r"/\S.*/(?:libmpi|libmpich|libmpi_cray|libmpi_gnu\w*)\.so\S*", maps)))


def _described(name: str, describe: Callable[[Problems], str], problems: Problems) -> str:
    try:
        return describe(problems)
    except ModuleNotFoundError:
        remedy = "install it from the distribution, conda-forge or the cluster's modules (see README.md)"
        problems.append(f"{name} is missing: {remedy if name in BUILT else f'pip install {name}'}.")
        return "missing"
    except Exception as error:  # a broken library may raise anything, and this verb must report it
        problems.append(f"{name} is there but fails: {' '.join(str(error).split()) or type(error).__name__}.")
        return "broken"


def _module_version(name: str, problems: Problems) -> str:
    module = importlib.import_module(name)
    return str(getattr(module, "__version__", None) or importlib.metadata.version(name))


def _mpi(problems: Problems) -> str:
    import mpi4py
    from mpi4py import MPI

    library = MPI.Get_library_version().split("\n")[0].split(",")[0].strip("\0 ")
    return f"{mpi4py.__version__} with {library} (MPI {'.'.join(map(str, MPI.Get_version()))})"


def _petsc(problems: Problems) -> str:
    import petsc4py
    from petsc4py import PETSc

    version, oldest = (".".join(map(str, numbers)) for numbers in (PETSc.Sys.getVersion(), OLDEST_PETSC))
    if PETSc.Sys.getVersion() < OLDEST_PETSC:
        problems.append(f"PETSc {version} is too old: {oldest} or newer is needed.")
    scalar, index = PETSc.ScalarType().dtype, PETSc.IntType().dtype
    if scalar.kind == "c":
        problems.append(
            "PETSc was built with complex scalars: use a real build (Debian: python3-petsc4py-real; "
            'conda-forge: "petsc=*=real*").'
        )
    config = petsc4py.get_config()
    folder = Path(config.get("PETSC_DIR", ""), config.get("PETSC_ARCH", ""))
    kinds = f"{scalar.name} scalars, {index.name} indices"
    return f"{version} (petsc4py {petsc4py.__version__}), {kinds}, in {folder}"


def _petsc_packages(problems: Problems) -> str:
    from petsc4py import PETSc

    present = [name for name in EXTERNAL if PETSc.Sys.hasExternalPackage(name)]
    absent = [name for name in EXTERNAL if name not in present]
    return f"{', '.join(present) or 'none'}; not: {', '.join(absent) or 'none'}"


def _h5py(problems: Problems) -> str:
    import h5py

    kinds = {True: "parallel", False: "serial"}
    return f"{h5py.__version__} with HDF5 {h5py.version.hdf5_version}, {kinds[h5py.get_config().mpi]}"


BUILT = ("mpi4py", "PETSc", "PETSc packages", "h5py", "gmsh")
"""Parts that are built for one MPI, or that pip should not lay over those of a distribution."""

PARTS: dict[str, Callable[[Problems], str]] = {
    "mpi4py": _mpi,
    "PETSc": _petsc,
    "PETSc packages": _petsc_packages,
    "h5py": _h5py,
    **{
        name: partial(_module_version, name) for name in ("gmsh", "numpy", "numba", "pydantic", "ruamel.yaml")
    },
}
"""The parts to describe, in this order; each function may also add problems."""
