"""Which parts of an installation do not fit together, and the remedy of each."""

from __future__ import annotations

from dataclasses import dataclass, field

OLDEST_PETSC = (3, 18)


@dataclass
class Facts:
    """What was found; ``None`` where the part is missing."""

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


def misfits(facts: Facts) -> list[str]:
    """One line for each misfit: what, and the remedy."""
    lines = [f"{name} is missing: {_source(name)}." for name in facts.missing]
    lines += [f"{name} is there but fails: {error}." for name, error in facts.broken.items()]
    if facts.ranks < facts.launched:
        lines.append(
            f"The launcher started {facts.launched} ranks but each of them sees {facts.ranks}: mpi4py was "
            "built with another MPI. Use the mpirun (or srun --mpi=…) of the MPI named above, or rebuild "
            "mpi4py and petsc4py with the launcher's."
        )
    if len(facts.mpi_libraries) > 1:
        lines.append(
            f"Two MPI libraries are loaded at once ({', '.join(facts.mpi_libraries)}): mpi4py, petsc4py and "
            "h5py must be built with the same one."
        )
    if facts.petsc is not None and facts.petsc[:2] < OLDEST_PETSC:
        found, least = ".".join(map(str, facts.petsc)), ".".join(map(str, OLDEST_PETSC))
        lines.append(f"PETSc {found} is too old: {least} or newer is needed.")
    if facts.complex_scalars:
        lines.append(
            "PETSc was built with complex scalars: use a real build (Debian: python3-petsc4py-real; "
            'conda-forge: "petsc=*=real*").'
        )
    threads = int(facts.threads) if facts.threads.isdigit() else 1
    crowded = max(facts.ranks_per_host.values(), default=1)
    if threads > 1 and threads * crowded > facts.cores:
        lines.append(
            f"OMP_NUM_THREADS={threads} on {crowded} ranks asks for more than the {facts.cores} cores of a "
            "host: set OMP_NUM_THREADS=1, the ranks are the parallelism."
        )
    return lines


def _source(name: str) -> str:
    if name in ("mpi4py", "PETSc", "h5py", "gmsh"):
        return "install it from the distribution, conda-forge or the cluster's modules (see README.md)"
    if name.startswith("PETSc "):
        return "it comes with petsc4py"
    return f"pip install {name}"
