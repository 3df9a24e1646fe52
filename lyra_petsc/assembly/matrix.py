"""The one PETSc matrix of a run, and the transfer of block rows into it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cached_property

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from lyra_petsc.assembly.pattern import BlockPattern, diagonal_keys
from lyra_petsc.assembly.product import HalfStored, MatMult, Whole
from lyra_petsc.assembly.storage import KINDS, Storage, StoredRows
from lyra_petsc.errors import InputError
from lyra_petsc.partition.points import Points


class SystemMatrix:
    """A symmetric matrix of 3×3 blocks with the couplings of a pattern.

    Parameters
    ----------
    points : Points
    pattern : BlockPattern
    kind : str
        PETSc matrix type where ``-mat_type`` says nothing (``baij``, ``aij``, ``sbaij``).
    given : bool
        Whether ``-mat_type`` and other options count.
    beside : SystemMatrix
        May share its ``rows`` with this one.
    diagonal : bool
        Only diagonal blocks are kept.

    Attributes
    ----------
    mat : PETSc.Mat
    followers : list of callables
        Are given the block rows (n_blocks, 3, 3) of the pattern whenever they change.
    rows : (n_blocks, 3, 3) float64
        Where to put new block rows together for ``set``: PETSc's own array if that has the same layout. As
        long as the matrix lives.
    """

    def __init__(
        self,
        points: Points,
        pattern: BlockPattern,
        kind: str,
        *,
        given: bool = True,
        beside: SystemMatrix | None = None,
        diagonal: bool = False,
    ) -> None:
        comm, rows = points.comm, 3 * points.n_owned
        self.mat = PETSc.Mat().create(comm)
        self.mat.setSizes(((rows, 3 * points.n_global), (rows, 3 * points.n_global)), bsize=3)
        self.mat.setType(kind)
        try:
            if given:
                self.mat.setFromOptions()
        except PETSc.Error:
            given = PETSc.Options().getString("mat_type", "")
            raise InputError(f"PETSc has no matrix type '{given}'", key="-mat_type") from None
        self.kind = str(self.mat.getType()).removeprefix("seq").removeprefix("mpi")
        self._shape, self._beside, self._diagonal = (pattern.n_blocks, 3, 3), beside, pattern.indptr[:-1]
        self._only_diagonal = diagonal
        if diagonal:
            keys = diagonal_keys(points.n_owned, points.n_local)
            pattern = BlockPattern.of_keys(keys, points.n_owned, points.n_local)
        self._stored = StoredRows(points, pattern, self.kind)
        self._preallocate(comm)
        # all rows are owned ones, and a block's values stand column by column
        for option, value in (("SYMMETRIC", True), ("NO_OFF_PROC_ENTRIES", True), ("ROW_ORIENTED", False)):
            self.mat.setOption(getattr(PETSc.Mat.Option, option), value)
        self.mat.setUp()
        self.followers: list[Callable[[NDArray[np.float64]], None]] = []
        self._read = True
        self._storage: Storage | None = None
        # zeros that nobody touches take no memory
        self._stored.insert(np.zeros((pattern.n_blocks, 3, 3)), self.mat)
        if self.kind in KINDS and PETSc.ScalarType == np.float64:
            with suppress(AttributeError, OSError):
                self._storage = Storage(self.mat, self.kind, pattern, self._stored)
        self._half = self.kind == "sbaij" and self._storage is not None
        with suppress(AttributeError, OSError):
            self._mult = self._faster_product(points, pattern)

    def _faster_product(self, points: Points, pattern: BlockPattern) -> MatMult | None:
        """A product in place of PETSc's, if there is a faster one."""
        if self._half:
            ghosts_of = points if points.comm.size > 1 else None
            return MatMult(self.mat, HalfStored(pattern, self.rows), pattern.n_couplings, ghosts_of)
        array = self._whole
        if array is None:
            return None
        # of several ranks PETSc multiplies by this part while the ghosts' values are on their way
        inside = self.mat.getDiagonalBlock()
        return MatMult(inside, Whole(inside, array), len(array))

    @property
    def _whole(self) -> NDArray[np.float64] | None:
        return self._storage.whole if self._storage is not None else None

    def _preallocate(self, comm: MPI.Comm) -> None:
        inside, outside = self._stored.inside, self._stored.outside
        if self.kind == "aij":
            inside, outside = np.repeat(3 * inside, 3), np.repeat(3 * outside, 3)
        self.mat.setPreallocationNNZ((inside, outside) if comm.size > 1 else inside)

    @cached_property
    def rows(self) -> NDArray[np.float64]:
        shared = self._storage.shared if self._storage is not None else None
        if shared is not None:
            return shared
        if self._beside is None or self._beside.kind == "sbaij":
            return np.zeros(self._shape)
        return self._beside.rows

    def set(self, values: NDArray[np.float64], larger: float = 0.0) -> None:
        """Replace all entries by block rows ``values`` (n_blocks, 3, 3); collective.

        Diagonal blocks become ``larger`` by this fraction.
        """
        if larger > 0.0:
            values = values.copy()
            values[self._diagonal] *= 1.0 + larger
        if self._only_diagonal:
            values = values[self._diagonal]
        for follower in self.followers:
            follower(values)
        if not self._read:
            self.mat.stateIncrease()
        elif self._storage is not None:
            if self._half and values is not self.rows:
                self.rows[:] = values
            self._storage.write(self.rows if self._half else values)
        else:
            self._stored.insert(values, self.mat)

    @property
    def multiplies_rows(self) -> bool:
        """Whether its products are those of ``rows``, whatever PETSc's entries are."""
        return self._half

    def unread(self) -> None:
        """From here on PETSc reads no entries: only the followers, and ``rows``, get new ones."""
        self._read = False
        if self._storage is not None:
            with suppress(AttributeError, OSError):
                self._storage.forget()

    @property
    def can_be_larger(self) -> bool:
        """Whether ``larger_diagonal`` is there: PETSc's entries can be written to behind its back."""
        return self._whole is not None

    @contextmanager
    def larger_diagonal(self, fraction: float) -> Iterator[None]:
        """Diagonal blocks are larger by this fraction for as long as something is made of them.

        PETSc is told of no change, so that what was made stays when they are as they were.
        """
        assert self._whole is not None
        blocks, at = self._whole, self._stored.diagonal
        kept = blocks[at]
        blocks[at] = (1.0 + fraction) * kept
        try:
            yield
        finally:
            blocks[at] = kept

    def destroy(self) -> None:
        """Free the matrix; collective."""
        self.mat.destroy()
