"""Comparison of the mesh of a resumed run with mesh.h5."""

from dataclasses import replace

import numpy as np
import pytest

from lyra_petsc.errors import InputError
from lyra_petsc.mesh.mesh import Group, Mesh, TriangleSurface
from lyra_petsc.output.layout import MESH_FILE
from lyra_petsc.output.mesh_file import check_same_mesh, write_mesh
from lyra_petsc.output.stored import StoredMesh

pytestmark = pytest.mark.parallel(3)

REST = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [2, 0, 0]], dtype=float)
TRIANGLES = np.array([[0, 1, 2], [1, 3, 2], [1, 4, 3]])
NOTHING = np.empty(0, int)
EDGES = np.array([[0, 1], [1, 4]])


def strip():
    groups = {
        "a/b": Group(1, np.array([0, 1, 4]), NOTHING, EDGES),
        "patch": Group(2, np.array([0, 1, 2]), np.array([0]), NOTHING.reshape(0, 2)),
    }
    return Mesh(REST + 1.0, REST, TRIANGLES, REST[TRIANGLES][..., :2], np.ones(3, dtype=bool), groups)


@pytest.fixture
def compare(comm, shared_tmp):
    """Compares a mesh, as it stands on rank 0, with the strip on disk."""
    write_mesh(shared_tmp, strip() if comm.rank == 0 else None, comm)

    def check(mesh, groups=("a/b", "patch")):
        check_same_mesh(shared_tmp, mesh if comm.rank == 0 else None, groups, comm)

    return check


def moved(rows, row, by):
    rows = rows.copy()
    rows[row, -1] += by
    return rows


def with_group(name, group):
    mesh = strip()
    return replace(mesh, groups=mesh.groups | {name: group})


POST = TriangleSurface(10.0 * REST, TRIANGLES)


def test_obstacles_are_stored_by_name(comm, shared_tmp):
    wall = TriangleSurface(REST[:3] + np.pi, TRIANGLES[:1])
    with_them = replace(strip(), obstacles={"a/b": POST, "wall": wall})
    write_mesh(shared_tmp, with_them if comm.rank == 0 else None, comm)
    stored = StoredMesh(shared_tmp).obstacles
    assert list(stored) == ["a/b", "wall"]
    for name, surface in with_them.obstacles.items():
        assert np.array_equal(stored[name].points, surface.points)
        assert np.array_equal(stored[name].triangles, surface.triangles)
    for now, words in (
        ({"wall": wall}, ""),
        ({"a/b": POST._replace(points=POST.points * (1 + 1e-15))}, ""),
        ({"a/b": POST._replace(points=moved(POST.points, 1, 1e-6))}, "obstacle 'a/b' is another mesh"),
        ({"a/b": wall}, "obstacle 'a/b' is another mesh"),
        ({"new": wall}, "obstacle 'new' is another mesh"),
    ):
        mesh = replace(strip(), obstacles=now) if comm.rank == 0 else None
        if not words:
            check_same_mesh(shared_tmp, mesh, (), comm)
            continue
        with pytest.raises(InputError, match=words):
            check_same_mesh(shared_tmp, mesh, (), comm)


def test_an_equal_mesh_is_accepted(compare):
    compare(strip())
    # another machine's rounding of a rotation
    compare(replace(strip(), positions=strip().positions * (1 + 1e-15), rest=REST * (1 + 1e-15)))
    compare(with_group("new", Group(0, np.array([3]), NOTHING, NOTHING.reshape(0, 2))), ("new", "patch"))


@pytest.mark.parametrize(
    ("mesh", "words"),
    [
        (replace(strip(), rest=moved(REST, 3, 1e-6)), "another shape at rest"),
        (replace(strip(), positions=moved(REST + 1, 4, 0.5)), "another shape at the start"),
        (replace(strip(), triangles=TRIANGLES[:, [1, 2, 0]]), "other triangles"),
        (
            replace(strip(), triangles=TRIANGLES[:2], triangle_uv=strip().triangle_uv[:2]),
            "2 triangles, not 5",
        ),
        (replace(strip(), triangle_uv=strip().triangle_uv * 1.1), "other material coordinates"),
        (replace(strip(), triangle_uv=moved(strip().triangle_uv, 1, 0.1)), "other material coordinates"),
        (with_group("a/b", Group(1, np.array([0, 1]), NOTHING, EDGES[:1])), "group 'a/b' has other members"),
        (
            with_group("patch", Group(0, np.array([0, 1, 2]), NOTHING, NOTHING)),
            "group 'patch' has other members",
        ),
    ],
)
def test_another_mesh_is_refused(compare, mesh, words):
    with pytest.raises(InputError, match=words) as caught:
        compare(mesh)
    assert "\n" not in str(caught.value)
    assert "run without --resume" in str(caught.value)


def test_a_group_that_the_scene_does_not_use_may_change(compare):
    compare(with_group("patch", Group(0, np.array([4]), NOTHING, NOTHING.reshape(0, 2))), ("a/b",))


@pytest.mark.parametrize("damage", [lambda path: path.unlink(), lambda path: path.write_bytes(b"no")])
def test_a_mesh_file_that_is_missing_or_damaged(comm, shared_tmp, compare, damage):
    comm.Barrier()
    if comm.rank == 0:
        damage(shared_tmp / MESH_FILE)
    comm.Barrier()
    with pytest.raises(InputError, match=r"mesh\.h5: cannot be read"):
        compare(strip())
