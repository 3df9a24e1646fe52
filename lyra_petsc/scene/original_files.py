"""The files a conf.json refers to: material tables, and vertex labels in .obj files."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, ValidationError

from lyra_petsc.errors import InputError
from lyra_petsc.materials.library import of_table
from lyra_petsc.materials.tables import ClothTable, entries
from lyra_petsc.nearest import nearest
from lyra_petsc.scene.block import Block
from lyra_petsc.scene.messages import input_error
from lyra_petsc.scene.text import parse_json, read_text
from lyra_petsc.scene.values import Positive, number, problem

STRETCHING_SHAPE = (6, 4)
BENDING_SHAPE = (3, 5)


def find_beside(name: str, scene: Path) -> Path | None:
    """The file ``name`` beside the scene, beside its folder, or in the working directory."""
    folder = scene.absolute().parent
    for directory in (folder, folder.parent, Path.cwd()):
        try:
            if (directory / name).is_file():
                return directory / name
        except (OSError, ValueError):
            return None
    return None


def _table(shape: tuple[int, int]) -> BeforeValidator:
    rows, columns = shape

    def check(value: Any) -> Any:
        right = isinstance(value, list) and len(value) == rows
        if not right or any(not isinstance(row, list) or len(row) != columns for row in value):
            raise problem(f"must be {rows} rows of {columns} numbers")
        return [[number(entry) for entry in row] for row in value]

    return BeforeValidator(check)


class MaterialFile(Block):
    """The tables of one cloth as the original's material files have them."""

    density: Positive
    stretching: Annotated[list[list[float]], _table(STRETCHING_SHAPE)]
    bending: Annotated[list[list[float]], _table(BENDING_SHAPE)]


def material_numbers(data: str, scene: Path, *, key: str) -> dict[str, Any]:
    """density, membrane and bending in our keys of the material that a conf.json names.

    The file if it exists, else the library's cloth of that name. Negative entries count as 0, as
    in the original.

    Raises
    ------
    InputError
        Neither a file nor a known name; a table that no sheet can have.
    """
    found = find_beside(data, scene)
    if found is not None:
        table = _read_material(found)
    else:
        cloths = {name: entry for name, entry in entries().items() if isinstance(entry, ClothTable)}
        name = Path(data).stem
        if name not in cloths:
            raise InputError(
                f"neither a file nor a library cloth: {data!r}, {nearest(name, cloths)}", file=scene, key=key
            )
        table = cloths[name]
    c11, c12, c22, c33 = (max(c, 0.0) for c in (table.c11, table.c12, table.c22, table.c33))
    if min(c11, c22, c33) == 0.0 or c11 * c22 <= c12 * c12:
        raise InputError(
            f"the small-strain row [{c11:g}, {c12:g}, {c22:g}, {c33:g}] N/m is not positive definite",
            file=found or scene,
            key="stretching[0]" if found else key,
        )
    at_0, at_45, at_90 = (max(k, 0.0) for k in table.bending)
    shell, _ = of_table(ClothTable(table.density, c11, c12, c22, c33, (at_0, at_45, at_90)), data)
    return {
        "density": shell.density,
        "membrane": {"c11": shell.c11, "c22": shell.c22, "c12": shell.c12, "c33": shell.c33},
        "bending": list(shell.bending),
    }


def _read_material(path: Path) -> ClothTable:
    data = parse_json(read_text(path), file=path)
    try:
        tables = MaterialFile.model_validate(data)
    except ValidationError as error:
        raise input_error(error, data, file=path) from None
    c11, c12, c22, c33 = tables.stretching[0]
    at_0, at_45, at_90 = (row[0] for row in tables.bending)
    return ClothTable(tables.density, c11, c12, c22, c33, (at_0, at_45, at_90))


class ObjLabels:
    """Vertex counts and vertex labels (``nl`` lines) of a scene's .obj files, read when asked for."""

    def __init__(self, files: list[Path]) -> None:
        self.files = files
        self._lines: dict[int, list[list[str]]] = {}

    def first_vertex(self, cloth: int) -> int:
        """Number of the cloth's first vertex when all are numbered consecutively."""
        return sum(1 for earlier in range(cloth) for words in self._words(earlier) if words[0] == "v")

    def labelled(self, cloth: int, label: int) -> list[int]:
        """Numbers of the cloth's vertices that bear ``label``; a label follows its vertex."""
        vertex = self.first_vertex(cloth) - 1
        found: list[int] = []
        for words in self._words(cloth):
            if words[0] == "v":
                vertex += 1
            elif words[0] == "nl" and words[1:2] == [str(label)]:
                found.append(vertex)
        return sorted({vertex for vertex in found if vertex >= 0})

    def has_texture_coordinates(self, cloth: int) -> bool:
        """Whether the cloth's rest shape is given by ``vt`` lines."""
        return any(words[0] == "vt" for words in self._words(cloth))

    def _words(self, cloth: int) -> list[list[str]]:
        if cloth not in self._lines:
            split = (
                line.split(maxsplit=2)[:2]
                for line in read_text(self.files[cloth], largest=math.inf).splitlines()
            )
            self._lines[cloth] = [words for words in split if words and words[0] in ("v", "nl", "vt")]
        return self._lines[cloth]
