"""Limit on the size of a mesh, checked against an estimate of the memory before it is allocated."""

from __future__ import annotations

import os
import resource
from pathlib import Path

from lyra_petsc.errors import InputError
from lyra_petsc.scene.values import LARGEST_INDEX

BYTES_PER_VERTEX = 2000
"""Memory [B] for a vertex on rank 0 during set-up (measured: 2400 for a whole run on one rank)."""

_CGROUP = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))


def available_memory() -> int:
    """Memory [B] that this process may use: the machine's, its container's or that of ``ulimit -v``."""
    limits = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    for file in _CGROUP:
        try:
            limits.append(int(file.read_text()))
        except (OSError, ValueError):  # no such group, or "max"
            continue
    allowed = resource.getrlimit(resource.RLIMIT_AS)[0]
    if allowed != resource.RLIM_INFINITY:
        limits.append(allowed)
    return min(limits)


def check_capacity(n_vertices: int, *, file: object | None, key: str | None) -> None:
    """Refuse a mesh that does not fit into memory.

    Raises
    ------
    InputError
        The message gives the number of vertices and the memory needed.
    """
    memory = available_memory()
    needed = n_vertices * BYTES_PER_VERTEX
    if needed <= memory and n_vertices <= LARGEST_INDEX:
        return
    limit = f"there are {memory / 2**30:.3g} GiB"
    if needed <= memory:
        limit = f"no more than {LARGEST_INDEX} can be numbered"
    raise InputError(
        f"{n_vertices} vertices take about {needed / 2**30:.3g} GiB, and {limit}; make the mesh coarser",
        file=file,
        key=key,
    )
