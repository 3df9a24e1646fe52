"""Run folders written by the writers of a run, without a simulation."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from mpi4py import MPI

from lyra_petsc.mesh.mesh import Mesh, TriangleSurface
from lyra_petsc.output.file_operations import replace_text
from lyra_petsc.output.history import HISTORY_COLUMNS, History
from lyra_petsc.output.mesh_file import write_mesh
from lyra_petsc.output.ordering import FileOrder
from lyra_petsc.output.states import StateWriter
from lyra_petsc.scene.dump import dump_scene
from lyra_petsc.scene.schema import Scene
from lyra_petsc.scene.text import parse_yaml

# a square ring: a hole in the middle, and vertices in no order of space
REST = np.array(
    [[0, 0, 0], [3, 3, 0], [3, 0, 0], [0, 3, 0], [1, 1, 0], [2, 2, 0], [2, 1, 0], [1, 2, 0]], dtype=float
)
TRIANGLES = np.array([[0, 2, 6], [0, 6, 4], [2, 1, 5], [2, 5, 6], [1, 3, 7], [1, 7, 5], [3, 0, 4], [3, 4, 7]])


# entries of a checkpoint
ENTRIES = {"time": 0.1 + 0.2, "step": 7, "last_state": 6, "notes": ["ü"], "budget": {"potential": -2e-3}}


def ring(vt: str = "each vertex") -> Mesh:
    """The ring with ``vt``:

    ``none``, ``each vertex``, or ``seam``, with one triangle elsewhere in the texture.
    """
    uv = REST[TRIANGLES][..., :2] / 3.0
    if vt == "seam":
        uv[3] += 0.25
    return Mesh(
        REST,
        REST,
        TRIANGLES,
        uv,
        np.ones(len(TRIANGLES), dtype=bool),
        has_uv=vt != "none",
    )


def position(state: int) -> np.ndarray:
    """Positions (V, 3) of a state, with numbers that have no short decimal form."""
    return REST + np.sin(state) * np.array([0.1, 0.0, 1.0]) * REST[:, :1] / 3.0 + [0.0, 0.0, state / 7.0]


def velocity(state: int) -> np.ndarray:
    return np.cos(state) * REST - 0.1


def stress(state: int) -> np.ndarray:
    return np.outer(np.arange(len(TRIANGLES)), [1.0, -2.0, 1.0 / 3.0]) * (1 + state)


def tensor(state: int) -> np.ndarray:
    """The stress with six components: uu, uv, uw, vv, vw, ww."""
    uu, vv, uv = stress(state).T
    none = np.zeros_like(uu)
    return np.stack([uu, uv, none, vv, none, none], axis=1)


def scene(**output: object) -> Scene:
    return Scene.model_validate(
        {
            "mesh": {"grid": {"width": 1, "height": 1, "nx": 1, "ny": 1}},
            "material": {"density": 0.1, "membrane": {"c11": 1, "c22": 1, "c12": 0, "c33": 1}, "bending": 0},
            "time": {"end": 1.0, "step": 0.1},
            "output": output,
        }
    )


class Writer:
    """A run that writes state after state, 0.1 s apart."""

    def __init__(self, folder: Path, vt: str = "each vertex", fields: bool = True) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        comm = MPI.COMM_SELF
        write_mesh(folder, ring(vt), comm)
        replace_text(
            folder / "scene.yaml", dump_scene(scene(fields=["velocity", "stress"] if fields else []))
        )
        self.fields = fields
        self.states = StateWriter(
            folder,
            FileOrder(comm, np.arange(len(REST)), len(REST)),
            FileOrder(comm, np.arange(len(TRIANGLES)), len(TRIANGLES)),
            n_triangles=len(TRIANGLES),
        )
        self.history = History(folder / "history.csv", HISTORY_COLUMNS, comm)
        self.count = 0

    def write(self) -> None:
        i, self.count = self.count, self.count + 1
        row = dict.fromkeys(HISTORY_COLUMNS, 0.5) | {"linear_iterations": 9, "rejected": 0}
        self.history.append(row | {"step": i, "time": 0.1 * i, "newton_iterations": 2})
        fields = {"velocity": ("vertex", velocity(i)), "stress": ("triangle", tensor(i))}
        self.states.write(i, 0.1 * i, position(i), fields if self.fields else {})()


def written(folder: Path, states: int = 3, vt: str = "each vertex", fields: bool = True) -> Path:
    """A run's folder with some states."""
    writer = Writer(folder, vt, fields)
    for _ in range(states):
        writer.write()
    writer.history.close()
    return folder


POST = TriangleSurface(np.array([[3.2, 0, 1], [4, 0, 1], [3.2, 1, 1.0]]), np.array([[0, 1, 2]]))
"""An obstacle: half a square beside the ring."""
OBSTACLES = {
    "ball": {
        "sphere": {"center": [0, 3.6, 0], "radius": 0.3},
        "motion": [{"time": 0}, {"time": 0.5, "translate": [1.5, 0, 0]}],
    },
    "post": {"mesh": {"file": "gone.obj"}},
}


def written_with_obstacles(folder: Path, obstacles: dict[str, object] = OBSTACLES) -> Path:
    """The run of the ring in a scene with obstacles, without the mesh files."""
    run = written(folder, states=6)
    write_mesh(run, replace(ring(), obstacles={"post": POST}), MPI.COMM_SELF)
    data = parse_yaml((run / "scene.yaml").read_text(), file=None) | {
        "contact": {"gap": 0.01},
        "obstacles": obstacles,
    }
    (run / "scene.yaml").write_text(dump_scene(Scene.model_validate(data)))
    return run
