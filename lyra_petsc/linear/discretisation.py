"""Local rows (owned and ghost) and block pattern of a rank, rebuilt when stencils change.

Fixed stencils determine the pattern once. Pairs in contact change: rows of other ranks that they need are
appended to the ghosts (`Discretisation.set_ghosts`), so that local numbers in fixed stencils stay valid. The
pattern is updated when a matrix is assembled (`Discretisation.update_pattern`), and kept while it has all
blocks. Owners of arrays of n_local rows are told of new ghosts; code that keeps arrays of n_blocks blocks
must compare ``rows`` with those for which they were made.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.arrays import Ints, Mask
from lyra_petsc.linear.block_rows import BlockRows
from lyra_petsc.linear.pattern import BlockPattern, union
from lyra_petsc.mesh.points import Layout
from lyra_petsc.terms.term import Coupling, Term

MAX_UNUSED = 0.1
"""Largest number of unused blocks that a pattern keeps, relative to the blocks of fixed stencils."""


class Discretisation:
    """Local rows and block rows of a scene on a rank.

    Parameters
    ----------
    layout : Layout
        Layout with the ghosts that fixed stencils need.
    terms : iterable of Term
        Terms whose Hessians are assembled into the matrix.

    Attributes
    ----------
    layout : Layout
        Layout with the ghosts that all stencils need.
    fixed, rows : BlockRows
        Block rows of fixed stencils only, and of all stencils; the same object if stencils do not change.
    fixed_positions : (n,) int64 or None
        Index in ``rows`` of each block of ``fixed``; None if both are the same.
    stencils_change : bool
        Whether any stencils depend on the positions.
    """

    def __init__(self, layout: Layout, terms: Iterable[Term]) -> None:
        self._fixed_layout = self.layout = layout
        self._changing: dict[str, NDArray[np.int32]] = {}  # present stencils that change, by term
        couplings: dict[str, Coupling] = {}
        for term in terms:
            if term.registration.of_contact:
                self._changing[term.name] = term.stencil
            else:
                couplings |= term.couplings
        self.stencils_change = bool(self._changing)
        self.fixed = BlockRows(BlockPattern(couplings, layout.n_owned, layout.n_local))
        self.rows = self.fixed
        self.fixed_positions: Ints | None = None
        self._rows_layout = layout  # for which ``rows`` were made
        self._located: set[str] = set()  # terms whose present stencils have offsets in the pattern
        self._extra_keys = np.empty(0, dtype=np.int64)  # keys of the blocks of ``rows`` that ``fixed`` lacks
        self._followers: list[Callable[[], None]] = []

    @property
    def fixed_ghosts(self) -> Ints:
        """Global numbers of the ghosts that fixed stencils need."""
        return self._fixed_layout.ghosts

    def when_ghosts_change(self, follow: Callable[[], None]) -> None:
        """Call ``follow``, which is collective, whenever the layout has other ghosts."""
        self._followers.append(follow)

    def set_ghosts(self, more: Ints) -> None:
        """Let the ghosts be those of fixed stencils and ``more`` (n,), global numbers; collective."""
        if self.layout is not self._fixed_layout:
            self.layout.destroy()
        self.layout = self._fixed_layout.with_ghosts(more)
        for follow in self._followers:
            follow()

    def replace_stencil(self, term: Term, stencil: NDArray[np.int32]) -> None:
        """Take the present stencil (E, n) of a term whose stencils change."""
        if not np.array_equal(stencil, self._changing[term.name]):
            self._located.discard(term.name)
        self._changing[term.name] = stencil

    def update_pattern(self, acting: Mapping[str, Mask]) -> bool:
        """Give ``rows`` the blocks of elements that act, ``acting`` (E,) by term; returns whether ``rows``
        changed; collective.

        Unused blocks stay up to `MAX_UNUSED`; elements that do not act get an offset if their block exists.
        Without terms that change, and without new ghosts, the pattern stays.
        """
        fits = fits_layout = self._rows_layout is self.layout  # not n_local: another may have as many rows
        if fits and not acting:
            return False
        n_local, pattern = self.layout.n_local, self.rows.pattern
        if fits:
            pattern.locate({name: s for name, s in self._changing.items() if name not in self._located})
            self._located = set(self._changing)
            fits = not any(pattern.misses_block(name, mask) for name, mask in acting.items() if len(mask))
        if not any(self.layout.global_max(not fits)):
            return False
        # includes elements that do not act yet, as some soon will
        soon = self.fixed.pattern.missing(self._changing.values(), n_local)
        kept = self._extra_keys if fits_layout else self._extra_keys[:0]
        few = len(kept) <= len(soon) + MAX_UNUSED * self.fixed.pattern.n_blocks
        self._extra_keys = union(kept, soon) if few else soon
        pattern, self.fixed_positions = self.fixed.pattern.extended(self._extra_keys, n_local)
        self.rows = BlockRows(pattern)
        pattern.locate(self._changing)
        self._rows_layout, self._located = self.layout, set(self._changing)
        return True

    def destroy(self) -> None:
        """Free the communication objects; collective."""
        if self.layout is not self._fixed_layout:
            self.layout.destroy()
        self._fixed_layout.destroy()
