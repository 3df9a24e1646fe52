"""The PETSc matrices of a run: the operator, and the matrix from which preconditioners are built."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from contextlib import suppress

import numpy as np
from petsc4py import PETSc

from lyra_petsc.arrays import Array
from lyra_petsc.errors import InputError
from lyra_petsc.linear.block_product import MAX_SCRATCH_ROWS, make_product
from lyra_petsc.linear.block_rows import BlockRows
from lyra_petsc.linear.low_rank import LowRank
from lyra_petsc.linear.pattern import BlockPattern, diagonal_keys
from lyra_petsc.linear.storage import KINDS, Storage, StoredRows
from lyra_petsc.mesh.points import Points

SUMMARIES = (PETSc.Viewer.Format.ASCII_INFO, PETSc.Viewer.Format.ASCII_INFO_DETAIL)
"""Viewer formats in which PETSc shows a matrix without its entries."""

ASSEMBLED = ("aij", "baij", "sbaij")
"""Matrix types that can be assembled from block rows."""


def _set_vec_type(mat: PETSc.Mat) -> None:
    """Let vectors created for a matrix have the type ``-vec_type``."""
    kind = PETSc.Options().getString("vec_type", "")
    if kind:
        mat.setVecType(kind)


class _Product:
    """Python context of a matrix of type ``python``: products with symmetric block rows, stored by half.

    PETSc's product for ``sbaij`` bypasses the caches and takes two to three times as long for matrices that
    fit into them; that for ``baij`` is not vectorised, and takes twice as long there.
    """

    def __init__(
        self,
        points: Points,
        pattern: BlockPattern,
        rows: Array,
        summary: Callable[[], list[str]] | None,
        entries: Callable[[], Array] | None,
    ) -> None:
        # weak: PETSc may free the matrix, and with it this context, after the end of Python and MPI, when the
        # objects of these methods, which own PETSc objects, must not be freed
        self._summary = None if summary is None else weakref.WeakMethod(summary)
        self._entries = None if entries is None else weakref.WeakMethod(entries)
        self._points = points if points.comm.size > 1 else None
        self._all_points, self._pattern, self._rows = points, pattern, rows
        self._multiply = make_product(pattern, rows)
        self._operations = 2.0 * 9.0 * pattern.n_couplings
        n_local = points.n_local if self._points is not None else 0
        self._local = np.empty((n_local, 3)) if n_local <= MAX_SCRATCH_ROWS else None
        self.dense: LowRank | None = None

    def mult(self, mat: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = A x; collective."""
        values = x.getArray(readonly=True).reshape(-1, 3)
        if self._points is not None:
            local = np.empty((self._points.n_local, 3)) if self._local is None else self._local
            local[: len(values)] = values
            self._points.update_ghosts(local)
            values = local
        out = y.getArray().reshape(-1, 3)
        self._multiply(values, out)
        if self.dense is not None:
            out += self.dense.product(values[: len(out)])
        PETSc.Log.logFlops(self._operations)

    multTranspose = mult  # the matrix is symmetric

    def view(self, mat: PETSc.Mat, viewer: PETSc.Viewer) -> None:
        """Show the entries (``-ksp_view_mat``) or a summary of their storage (``-ksp_view``); collective."""
        if viewer.getType() == PETSc.Viewer.Type.ASCII and viewer.getFormat() in SUMMARIES:
            summary = None if self._summary is None else self._summary()
            lines = ["block rows of the program, of which one half is stored"]
            lines += summary() if summary else []
            viewer.printfASCII("".join(f"  {line}\n" for line in lines))
            return
        whole = AssembledMatrix(self._all_points, self._pattern, "aij")
        entries = None if self._entries is None else self._entries()
        whole.set(self._rows if entries is None else entries())
        whole.mat.view(viewer)
        whole.destroy()


class BlockMatrix:
    """A symmetric matrix of 3×3 blocks in this program's block rows, for which PETSc only calls products.

    Parameters
    ----------
    points : Points
    pattern : BlockPattern
    summary : method or None
        Further lines of ``-ksp_view``; collective. Its object is referenced weakly.
    rows : (n_stored, 3, 3) float64, optional
        Array for the block rows.
    entries : method, optional
        Returns the block rows if ``rows`` may have been overwritten. Its object is referenced weakly.

    Attributes
    ----------
    mat : PETSc.Mat
        A matrix of type ``python``.
    rows : (n_stored, 3, 3) float64
        The block rows; ``set`` tells PETSc that they changed.
    observers : list of callables
        Called with the block rows whenever they change.
    """

    kind = "python"

    def __init__(
        self,
        points: Points,
        pattern: BlockPattern,
        summary: Callable[[], list[str]] | None = None,
        rows: Array | None = None,
        entries: Callable[[], Array] | None = None,
    ) -> None:
        n = 3 * points.n_owned
        self.mat = PETSc.Mat().create(points.comm)
        self.mat.setSizes(((n, 3 * points.n_global), (n, 3 * points.n_global)), bsize=3)
        self.mat.setType(PETSc.Mat.Type.PYTHON)
        self.mat.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        self._blocks = BlockRows(pattern)
        self.rows = self._blocks.zeros() if rows is None else rows
        self.observers: list[Callable[[Array], None]] = []
        self._product = _Product(points, pattern, self.rows, summary, entries)
        self.mat.setPythonContext(self._product)
        _set_vec_type(self.mat)
        self.mat.setUp()
        # a matrix that PETSc frees after the end of Python must not call Python
        self._detach = weakref.finalize(self, self.mat.setType, PETSc.Mat.Type.SHELL)

    def set(self, values: Array, shift: float = 0.0) -> None:
        """Replace all entries by block rows ``values`` (n_stored, 3, 3), mostly ``rows`` itself; collective.

        Diagonal blocks, and diagonal entries of edges, are multiplied by 1 + shift.
        """
        if values is not self.rows:
            self.rows[:] = values
        if shift > 0.0:
            self._blocks.scale_diagonal(self.rows, 1.0 + shift)
        for observer in self.observers:
            observer(self.rows)
        self.mat.assemble()
        self.mat.stateIncrease()

    def add_dense(self, dense: LowRank | None) -> None:
        """Add a matrix to products, in place of the last one, but not to ``rows``."""
        self._product.dense = dense

    def destroy(self) -> None:
        """Free the matrix; collective."""
        # solvers that are not freed yet may keep the matrix until the end of Python
        self._detach()
        self.mat.destroy()


class AssembledMatrix:
    """A symmetric matrix of 3×3 blocks whose entries PETSc stores.

    Parameters
    ----------
    points : Points
    pattern : BlockPattern
    kind : str
        PETSc matrix type unless ``-mat_type`` is given (``baij``, ``aij``, ``sbaij``).
    prefix : str
        Prefix of its options, such as ``-mat_type``.
    diagonal : bool
        Whether only diagonal blocks are stored.

    Attributes
    ----------
    mat : PETSc.Mat
    rows : (n_stored, 3, 3) float64
        Work array in which new block rows may be assembled for ``set``.
    """

    def __init__(
        self, points: Points, pattern: BlockPattern, kind: str, *, prefix: str = "", diagonal: bool = False
    ) -> None:
        comm, rows = points.comm, 3 * points.n_owned
        self.mat = PETSc.Mat().create(comm)
        self.mat.setSizes(((rows, 3 * points.n_global), (rows, 3 * points.n_global)), bsize=3)
        self.mat.setType(kind)
        if not diagonal:
            self._set_from_options(prefix)
        self.kind = str(self.mat.getType()).removeprefix("seq").removeprefix("mpi")
        self._pattern, pattern = pattern, pattern.whole
        self._diagonal, self._only_diagonal = pattern.indptr[:-1], diagonal
        self._rows: Array | None = None
        if diagonal:
            keys = diagonal_keys(points.n_owned, points.n_local)
            pattern = BlockPattern.of_keys(keys, points.n_owned, points.n_local)
        self._stored = StoredRows(points, pattern, self.kind)
        inside, outside = self._stored.inside, self._stored.outside
        if self.kind == "aij":
            inside, outside = np.repeat(3 * inside, 3), np.repeat(3 * outside, 3)
        self.mat.setPreallocationNNZ((inside, outside) if comm.size > 1 else inside)
        for option, value in (
            ("SYMMETRIC", True),
            ("NO_OFF_PROC_ENTRIES", True),  # only owned rows are set
            ("ROW_ORIENTED", False),  # blocks are stored column by column
            # the preallocation sets it except on ranks without rows; assembly needs it equal on all ranks
            ("NEW_NONZERO_ALLOCATION_ERR", True),
        ):
            self.mat.setOption(getattr(PETSc.Mat.Option, option), value)
        _set_vec_type(self.mat)
        self.mat.setUp()
        # (pages of np.zeros that are not touched take no memory)
        self._stored.insert(np.zeros((pattern.n_blocks, 3, 3)), self.mat)
        self._storage: Storage | None = None
        ascending = bool(np.all(np.diff(points.ghosts) > 0))
        if self.kind in KINDS and PETSc.ScalarType == np.float64 and ascending:
            with suppress(AttributeError, OSError):
                self._storage = Storage(self.mat, self.kind, pattern, self._stored)

    def _set_from_options(self, prefix: str) -> None:
        kind = PETSc.Options(prefix).getString("mat_type", self.mat.getType())
        self.mat.setOptionsPrefix(prefix)
        # checked first, as PETSc crashes with some types
        fits = kind.removeprefix("seq").removeprefix("mpi") in ASSEMBLED
        try:
            if fits:
                self.mat.setFromOptions()
        except PETSc.Error:
            fits = False
        if not fits:
            self.mat.destroy()
            allowed = ", ".join(ASSEMBLED)
            raise InputError(
                f"'{kind}' cannot be filled by blocks here; take {allowed}", key=f"-{prefix}mat_type"
            )

    @property
    def rows(self) -> Array:
        if self._rows is None:
            self._rows = np.zeros((self._pattern.n_stored, 3, 3))
        return self._rows

    def set(self, values: Array, shift: float = 0.0) -> None:
        """Replace all entries by block rows ``values`` (n_stored, 3, 3); collective.

        Diagonal blocks are multiplied by 1 + shift.
        """
        values = self._pattern.in_blocks(values)
        diagonal = values[self._diagonal]
        if self._only_diagonal:
            values = (1.0 + shift) * diagonal
        elif shift > 0.0:
            values[self._diagonal] = (1.0 + shift) * diagonal
        if self._storage is not None:
            self._storage.write(values)
        else:
            self._stored.insert(values, self.mat)
        if shift > 0.0 and not self._only_diagonal:
            values[self._diagonal] = diagonal

    def cholesky(self) -> PETSc.KSP:
        """A solver by Cholesky factors, by MUMPS if PETSc has it, with the matrix's prefix; collective.

        The caller owns it; its ``setUp`` computes the factors.
        """
        ksp, prefix = PETSc.KSP().create(self.mat.getComm()), self.mat.getOptionsPrefix()
        ksp.setOptionsPrefix(prefix)
        ksp.setType(PETSc.KSP.Type.PREONLY)
        ksp.setOperators(self.mat)
        pc = ksp.getPC()
        pc.setType(PETSc.PC.Type.CHOLESKY)
        if PETSc.Sys.hasExternalPackage("mumps"):
            pc.setFactorSolverType("mumps")
            pc.setFactorSetUpSolverType()
            pc.getFactorMatrix().setOptionsPrefix(prefix)  # else it takes the options of the steps' factors
        return ksp

    def solve(self, ksp: PETSc.KSP, right: Array) -> Array:
        """Solution (n_owned, 3) for a right-hand side by a solver of this matrix; collective."""
        x, b = self.mat.createVecs()
        b.setArray(right.ravel())
        ksp.solve(b, x)
        solution: Array = x.getArray(readonly=True).reshape(right.shape).copy()
        x.destroy()
        b.destroy()
        return solution

    def destroy(self) -> None:
        """Free the matrix; collective."""
        self.mat.destroy()


Matrix = BlockMatrix | AssembledMatrix
