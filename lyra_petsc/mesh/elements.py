"""Elements of one term: the points that each couples, and its constants."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Ints


@dataclass
class Elements:
    """Elements of one kind: all of them (rank 0, numbering of the mesh), or of one rank (local numbering).

    Attributes
    ----------
    stencil : (E, n) int
        The vertices that each element couples; local numbers are those of block rows.
    edges : (E, m) int or None
        The edges whose unknowns each element couples: before distribution indices into the edges of the
        mesh, then indices into a flattened array of local block rows (`Layout`).
    data : mapping of name → (E, …) array
        Constants of each element, distributed with the stencil.
    n_owned : int
        The first ``n_owned`` elements are counted on this rank (energies, diagnostics); the others couple a
        row that it owns, too. Equal to E before distribution.
    index : (E,) int64; after distribution int32 where E permits
        Number of each element before distribution.
    """

    stencil: NDArray[np.int32] | Ints
    data: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    n_owned: int = -1
    index: NDArray[np.int32] | Ints = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    edges: NDArray[np.int32] | Ints | None = None

    def __post_init__(self) -> None:
        if self.n_owned < 0:
            self.n_owned = len(self.stencil)
            self.index = np.arange(len(self.stencil), dtype=np.int64)

    def compress(self, name: str) -> Elements:
        """The same elements; the constant ``name`` takes no memory if it is one number for all of them."""
        values = self.data.get(name)
        if values is None or len(values) == 0 or values.ndim > 1 or (values != values[0]).any():
            return self
        return replace(self, data={**self.data, name: np.broadcast_to(values[0].copy(), values.shape)})

    def without(self, *names: str) -> Elements:
        """The same elements without these constants, which a term stores in another form."""
        return replace(self, data={key: self.data[key] for key in self.data if key not in names})
