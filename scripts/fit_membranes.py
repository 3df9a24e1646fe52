"""Fits the law ``measured`` to the strained rows of the cloths' tables, and writes the results into their
file.

``python scripts/fit_membranes.py`` (a second). The tables are read as ARCSim does: c11, c12 and c22 count
twice, and C is interpolated linearly in the larger principal strain, up to the strained row, and in its angle
between rows. The samples are six strains up to the measured one in the five measured directions, with 0 and
±0.3 of that strain across. The error is the root mean square of the stress error over that of the stress.
"""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path

import numpy as np
from scipy.optimize import nnls

from lyra_petsc.arrays import Array
from lyra_petsc.scene.materials.library import ShellMaterial, resolve_material
from lyra_petsc.scene.schema import Material
from lyra_petsc.terms.membrane_laws import measured

FILE = Path(measured.__file__).with_name("wang2011.json")
ANGLES = np.radians([0.0, 22.5, 45.0, 67.5, 90.0])
STRAINS = measured.MEASURED * np.arange(1, 7) / 6.0
ACROSS = (-0.3, 0.0, 0.3)
NORM = np.sqrt([1.0, 1.0, 2.0])
"""Weights of S_uu, S_vv, S_uv in the norm of a stress."""


def stiffness(row: list[float]) -> Array:
    """C (3, 3) [N/m] of a table's row."""
    c11, c12, c22, c33 = row
    return np.array([[2 * c11, 2 * c12, 0.0], [2 * c12, 2 * c22, 0.0], [0.0, 0.0, c33]])


def samples(rest: Array, strained: list[list[float]]) -> tuple[Array, Array]:
    """Strains e (n, 3) and the tables' stresses (n, 3) [N/m]."""
    found = []
    for (number, angle), strain, across in product(enumerate(ANGLES), STRAINS, ACROSS):
        one = 0.5 * ((1.0 + strain) ** 2 - 1.0)
        two, c, s = across * one, np.cos(angle), np.sin(angle)
        e = [one * c * c + two * s * s, one * s * s + two * c * c, 2.0 * (one - two) * c * s]
        fraction = strain / measured.MEASURED
        c_at = (1.0 - fraction) * rest + fraction * stiffness(strained[number])
        found.append((e, c_at @ e))
    e, stress = zip(*found, strict=True)
    return np.array(e), np.array(stress)


def at_rest(shell: ShellMaterial) -> Array:
    """The library's C (3, 3) [N/m]."""
    return np.array([[shell.c11, shell.c12, 0.0], [shell.c12, shell.c22, 0.0], [0.0, 0.0, shell.c33]])


def slopes(e: Array) -> Array:
    """Stress (n, 3, 6) of each a_k = 1 at strains e (n, 3)."""
    columns = []
    for forms in measured.FIBRES:
        n = np.array(forms)
        s = np.maximum(e @ n.T, 0.0)
        full = measured.FULL_STRAIN
        rise = np.where(s < full, 0.5 * s * s / full, s - 0.5 * full)
        columns.append(rise @ n)
    return np.stack(columns, axis=2)


def fitted(name: str, strained: list[list[float]]) -> dict[str, object]:
    """The file's entry of a cloth."""
    rest = at_rest(resolve_material(Material(cloth=name))[0])
    e, stress = samples(rest, strained)
    size, remainder = np.linalg.norm(stress * NORM), (stress - e @ rest) * NORM
    basis = (slopes(e) * NORM[:, None]).reshape(remainder.size, -1)
    stiffening, error = nnls(basis, remainder.ravel())
    return {
        "strained": strained,
        "stiffening": [float(f"{a:.5g}") for a in stiffening],
        "error": float(f"{error / size:.3f}"),
        "error_of_stvk": float(f"{np.linalg.norm(remainder) / size:.3f}"),
    }


def main() -> None:
    """Fit all cloths of the file."""
    content = json.loads(FILE.read_text(encoding="utf-8"))
    rows = {name: fitted(name, row["strained"]) for name, row in content["cloths"].items()}
    lines = ",\n".join(f"    {json.dumps(name)}: {json.dumps(row)}" for name, row in rows.items())
    text = f'{{\n  "source": {json.dumps(content["source"])},\n  "cloths": {{\n{lines}\n  }}\n}}\n'
    FILE.write_text(text, encoding="utf-8")
    for name, row in rows.items():
        print(f"{name:20} error {row['error']:5.1%}, of stvk {row['error_of_stvk']:5.1%}")


if __name__ == "__main__":
    main()
