"""Elements of one term: which points they couple and the numbers that belong to them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Ints


@dataclass
class Elements:
    """A set of like elements, whole (rank 0, mesh numbering) or of one rank (local numbering).

    Attributes
    ----------
    stencil : (E, n) int
        The vertices that each element couples; local numbers are those of block rows.
    edges : (E, m) int or None
        The edges whose unknowns it couples: indices into the mesh's edges before distribution, after it
        places in the flat form of an array over the local block rows (`Layout`).
    data : mapping of name → (E, …) array
        Constants of each element, sliced along with the stencil when distributed.
    n_owned : int
        The first ``n_owned`` elements are counted on this rank (energies, diagnostics); the
        rest also touch a vertex that it owns. Equal to E before distribution.
    index : (E,) int64; int32 after distribution, where that counts so far
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

    def once(self, name: str) -> Elements:
        """The same elements, where a constant that is one number for all of them takes no memory."""
        values = self.data.get(name)
        if values is None or len(values) == 0 or values.ndim > 1 or (values != values[0]).any():
            return self
        return replace(self, data={**self.data, name: np.broadcast_to(values[0].copy(), values.shape)})

    def without(self, *names: str) -> Elements:
        """The same elements without these constants, which their term keeps in a form of its own."""
        return replace(self, data={key: self.data[key] for key in self.data if key not in names})
