"""Checks whether the parts of an installation fit together, and what to do where they do not."""

from __future__ import annotations

from dataclasses import dataclass, field

OLDEST_PETSC = (3, 18)


@dataclass
class Installation:
    """What was found; ``None`` where a part is missing."""

    ranks: int = 1
    launched: int = 1
    """Ranks the launcher says it started."""
    ranks_per_host: dict[str, int] = field(default_factory=dict)
    cores: int = 1
    """Of the host of rank 0."""
    threads: str = ""
    """OMP_NUM_THREADS as it stands; empty when unset."""
    petsc: tuple[int, ...] | None = None
    complex_scalars: bool = False
    mpi_libraries: tuple[str, ...] = ()
    """Files of the MPI libraries loaded."""
    missing: list[str] = field(default_factory=list)
    broken: dict[str, str] = field(default_factory=dict)


def misfits(found: Installation) -> list[str]:
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
        version, least = ".".join(map(str, found.petsc)), ".".join(map(str, OLDEST_PETSC))
        lines.append(f"PETSc {version} is too old: {least} or newer is needed.")
    if found.complex_scalars:
        lines.append(
            "PETSc was built with complex scalars: use a real build (Debian: python3-petsc4py-real; "
            'conda-forge: "petsc=*=real*").'
        )
    threads = int(found.threads) if found.threads.isdigit() else 1
    crowded = max(found.ranks_per_host.values(), default=1)
    if threads > 1 and threads * crowded > found.cores:
        lines.append(
            f"OMP_NUM_THREADS={threads} on {crowded} ranks asks for more than the {found.cores} cores of a "
            "host: set OMP_NUM_THREADS=1, the ranks are the parallelism."
        )
    return lines


def _source(name: str) -> str:
    if name in ("mpi4py", "PETSc", "h5py", "gmsh"):
        return "install it from the distribution, conda-forge or the cluster's modules (see README.md)"
    if name.startswith("PETSc "):
        return "it comes with petsc4py"
    return f"pip install {name}"
