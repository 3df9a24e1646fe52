"""The XDMF text that shows state files as a time series in ParaView.

states.xdmf grows by one state at a time, and is a whole document at every moment.

Behind the end of the document stands an XML processing instruction full of spaces. A state is written into
it, with another end of the document and the opening of another such instruction behind it: so far nothing of
this counts. Then the former end is overwritten with spaces, in one write within one page of the file, and
what was the instruction's is the document's. Who reads meanwhile sees one or the other. Only where the room
is used up is the file copied, with an eighth more.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from lyra_petsc.output.agreement import cannot_write, replaced

XDMF_FILE = "states.xdmf"
MESH_FILE = "mesh.h5"


@dataclass(frozen=True)
class StoredField:
    """A dataset of a state.

    Attributes
    ----------
    name : str
        Its name in the state's group.
    on : str
        ``"vertex"`` or ``"triangle"``: what its rows belong to.
    shape : tuple of int
        Rows first.
    dtype : str
        numpy's name of the stored type.
    """

    name: str
    on: str
    shape: tuple[int, ...]
    dtype: str


@dataclass(frozen=True)
class WrittenState:
    """A state file that is complete on disk.

    Attributes
    ----------
    number : int
        0 for the initial state, then one more for each written state.
    step : int
        Accepted steps before it.
    time : float
        [s].
    file : str
        File name, relative to the XDMF file.
    fields : tuple of StoredField
        What it holds besides the positions.
    """

    number: int
    step: int
    time: float
    file: str
    fields: tuple[StoredField, ...]


# a row's number of components, as XDMF names it; other widths are matrices
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
    """The document that shows states of one mesh.

    Parameters
    ----------
    n_vertices, n_triangles : int
        Rows of positions and of triangles.
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
        """A state's part of it."""
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
"""The end of the document, and the opening of the room behind it."""

ROOM_END = b"?>\n"

PAGE = 4096
"""What a process that is killed writes whole or not at all [bytes]."""

LEAST_ROOM, MOST_ROOM = 1 << 14, 1 << 20
"""Bytes; XML readers keep an instruction in memory, and refuse one of 10 MB."""


class GrowingXdmf:
    """The file; for one rank.

    Parameters
    ----------
    path : Path
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._seam = 0
        self._size = -1

    def replace(self, grids: Iterable[str]) -> None:
        """Write the document of these states.

        Raises
        ------
        OutputError
            If it could not be written; what stood there before stands.
        """
        self._make([DOCUMENT_START.encode(), *(grid.encode() for grid in grids)], copied=0)

    def append(self, grid: str) -> None:
        """Announce one more state.

        Raises
        ------
        OutputError
            If it could not be; what was announced stands.
        FileNotFoundError
            If somebody has removed or changed the file.
        """
        text = grid.encode()
        begin = self._seam + len(SEAM)
        begin += _pad(begin + len(text))
        try:
            status = self.path.stat()
            if status.st_size != self._size:
                raise FileNotFoundError
            if begin + len(text) + len(SEAM) + len(ROOM_END) > self._size:
                self._make([text], copied=self._seam)
                return
            with open(self.path, "r+b", buffering=0) as file:
                os.pwrite(file.fileno(), text + SEAM, begin)
                os.fdatasync(file.fileno())  # never after what makes it count
                os.pwrite(file.fileno(), b" " * len(SEAM), self._seam)
        except FileNotFoundError:
            raise
        except OSError as error:
            raise cannot_write(self.path, error) from error
        self._seam = begin + len(text)

    def _make(self, pieces: list[bytes], copied: int) -> None:
        """The first ``copied`` bytes of the file and these pieces, with new room, under its name."""
        with replaced(self.path) as new:
            if copied:
                with open(self.path, "rb") as old:
                    while new.tell() < copied:
                        new.write(old.read(min(copied - new.tell(), MOST_ROOM)))
            new.writelines(pieces)
            new.write(b" " * _pad(new.tell()))
            seam = new.tell()
            new.write(SEAM)
            new.write(b" " * min(max(seam // 8, LEAST_ROOM), MOST_ROOM) + ROOM_END)
            size = new.tell()
        self._seam, self._size = seam, size


def _pad(seam: int) -> int:
    """Bytes by which a seam has to move to lie within one page."""
    return -seam % PAGE if seam % PAGE + len(SEAM) > PAGE else 0
