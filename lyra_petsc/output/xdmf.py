"""states.xdmf: the XDMF document that presents the states files as a time series to ParaView.

states.xdmf grows by one state at a time, and is a valid XML document at any time. The end of the document
is followed by reserved space: an XML processing instruction that is filled with spaces. Appending a state
takes two writes. The first writes, into the reserved space, the state's text, another end of the document
and the opening of another such instruction; readers still ignore all of it. The second overwrites the former
end of the document with spaces, within one page of the file, so that a concurrent reader sees either the old
or the new document. If the reserved space is used up, the file is copied and gets new one.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from lyra_petsc.output.file_operations import atomic_write, cannot_write, open_output
from lyra_petsc.output.layout import MESH_FILE


@dataclass(frozen=True)
class StoredField:
    """A dataset of a state.

    Attributes
    ----------
    name : str
        Name of the dataset in the state's group.
    on : str
        ``"vertex"`` or ``"triangle"``: what its rows belong to.
    shape : tuple of int
        Number of rows, then the shape of a row.
    dtype : str
        numpy's name of the stored type.
    """

    name: str
    on: str
    shape: tuple[int, ...]
    dtype: str


@dataclass(frozen=True)
class WrittenState:
    """A state on disk.

    Attributes
    ----------
    number : int
        0 for the initial state, then one more for each written state.
    step : int
        Number of accepted steps before the state.
    time : float
        [s].
    file : str
        Name of the states file, relative to the XDMF file.
    fields : tuple of StoredField
        The state's datasets besides the positions.
    """

    number: int
    step: int
    time: float
    file: str
    fields: tuple[StoredField, ...]


# XDMF's attribute type by the number of components of a row; other numbers are matrices
ATTRIBUTE_TYPES = {1: "Scalar", 3: "Vector", 6: "Tensor6", 9: "Tensor"}
CENTERS = {"vertex": "Node", "triangle": "Cell"}


DOCUMENT_START = (
    '<?xml version="1.0"?>\n<Xdmf Version="3.0">\n <Domain>\n'
    '  <Grid Name="states" GridType="Collection" CollectionType="Temporal">\n'
)
DOCUMENT_END = "  </Grid>\n </Domain>\n</Xdmf>\n"


def group_name(number: int) -> str:
    """The HDF5 group of a state in its file."""
    return f"states/{number:06d}"


class TimeSeries:
    """The XDMF text of states that share one mesh.

    Parameters
    ----------
    n_vertices, n_triangles : int
    """

    def __init__(self, n_vertices: int, n_triangles: int) -> None:
        self._n_vertices = n_vertices
        triangles = _item((n_triangles, 3), "int64", f"{MESH_FILE}:/mesh/triangles")
        self._before = (
            f'   <Topology TopologyType="Triangle" NumberOfElements="{n_triangles}">{triangles}</Topology>\n'
        )
        rest = StoredField("rest", "vertex", (n_vertices, 3), "float64")
        self._after = _attribute(rest, f"{MESH_FILE}:/mesh/rest")

    def text(self, states: Sequence[WrittenState]) -> str:
        """The whole document, states in the order given."""
        return DOCUMENT_START + "".join(map(self.grid, states)) + DOCUMENT_END

    def grid(self, state: WrittenState) -> str:
        """The part of the document on one state."""
        group = f"{state.file}:/{group_name(state.number)}"
        position = _item((self._n_vertices, 3), "float64", f"{group}/position")
        return (
            f'  <Grid Name="state {state.number}" GridType="Uniform">\n'
            f'   <Time Value="{state.time!r}"/>\n{self._before}'
            f'   <Geometry GeometryType="XYZ">{position}</Geometry>\n'
            + "".join(_attribute(field, f"{group}/{field.name}") for field in state.fields)
            + f"{self._after}  </Grid>\n"
        )


def _attribute(field: StoredField, where: str) -> str:
    kind = ATTRIBUTE_TYPES.get(int(np.prod(field.shape[1:], dtype=int)), "Matrix")
    return (
        f'   <Attribute Name={quoteattr(field.name)} AttributeType="{kind}" Center="{CENTERS[field.on]}">'
        f"{_item(field.shape, field.dtype, where)}</Attribute>\n"
    )


def _item(shape: tuple[int, ...], dtype: str, where: str) -> str:
    kind = np.dtype(dtype)
    number = {"f": "Float", "i": "Int", "u": "UInt"}[kind.kind]
    return (
        f'<DataItem Format="HDF" NumberType="{number}" Precision="{kind.itemsize}" '
        f'Dimensions="{" ".join(map(str, shape))}">{where}</DataItem>'
    )


SEAM = (DOCUMENT_END + "<?room ").encode()
"""End of the document and beginning of the reserved space after it."""

RESERVE_END = b"?>\n"

PAGE = 4096
"""Size of a block that a killed process writes either completely or not at all [bytes]."""

RESERVE = 1 << 16
"""Size of the reserved space [bytes]; XML readers keep it in memory."""


class GrowingXdmf:
    """The file states.xdmf, to which states are appended; for one rank.

    Parameters
    ----------
    path : Path
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._seam = 0
        self._size = -1

    def replace(self, grids: Iterable[str]) -> None:
        """Replace the document by one with these states.

        Raises
        ------
        OutputError
            If the file cannot be written; then the old file is kept.
        """
        self._write_document([DOCUMENT_START.encode(), *(grid.encode() for grid in grids)], copied=0)

    def append(self, grid: str) -> None:
        """Append one state.

        Raises
        ------
        OutputError
            If the file cannot be written; the document is then unchanged.
        FileNotFoundError
            If another process has removed or changed the file.
        """
        text = grid.encode()
        begin = self._seam + len(SEAM)
        begin += _pad(begin + len(text))
        try:
            status = self.path.stat()
            if status.st_size != self._size:
                raise FileNotFoundError
            if begin + len(text) + len(SEAM) + len(RESERVE_END) > self._size:
                self._write_document([text], copied=self._seam)
                return
            with open_output(self.path, "r+b", buffering=0) as file:
                os.pwrite(file.fileno(), text + SEAM, begin)
                os.pwrite(file.fileno(), b" " * len(SEAM), self._seam)
        except FileNotFoundError:
            raise
        except OSError as error:
            raise cannot_write(self.path, error) from error
        self._seam = begin + len(text)

    def _write_document(self, pieces: list[bytes], copied: int) -> None:
        """Replace the file by its first ``copied`` bytes, the pieces and new reserved space."""
        with atomic_write(self.path) as new:
            if copied:
                with open(self.path, "rb") as old:
                    while new.tell() < copied:
                        new.write(old.read(min(copied - new.tell(), RESERVE)))
            new.writelines(pieces)
            new.write(b" " * _pad(new.tell()))
            seam = new.tell()
            new.write(SEAM)
            new.write(b" " * RESERVE + RESERVE_END)
            size = new.tell()
        self._seam, self._size = seam, size


def _pad(seam: int) -> int:
    """Number of bytes by which `SEAM` at offset ``seam`` must move to lie within one page."""
    return -seam % PAGE if seam % PAGE + len(SEAM) > PAGE else 0
