"""Names of the sheets of a mesh, for messages."""

from __future__ import annotations

from collections import Counter

import numpy as np

from lyra_petsc.arrays import Ints
from lyra_petsc.mesh.mesh import Mesh
from lyra_petsc.mesh.topology import connected_pieces


def named_sheets(mesh: Mesh) -> tuple[Ints, list[str]]:
    """The connected pieces of a mesh: the number (F,) of that of each triangle, and their names.

    A piece is called as its source is; if several have a name, a number from 1 on follows it.
    """
    piece = connected_pieces(mesh.triangles)
    first = np.unique(piece, return_index=True)[1]
    ends = np.cumsum([source.n_triangles for source in mesh.sources])
    labels = [mesh.sources[number].label for number in np.searchsorted(ends, first, side="right")]
    of_label, seen, names = Counter(labels), Counter[str](), []
    for label in labels:
        seen[label] += 1
        names.append(label if of_label[label] == 1 else f"{label} {seen[label]}")
    return piece, names
