"""Checkpoints: written, read by other partitions, kept twice, refused."""

import numpy as np
import pytest
from written_run import ENTRIES

from lyra_petsc.errors import InputError
from lyra_petsc.output.checkpoint import read_checkpoint, write_checkpoint
from lyra_petsc.output.layout import CHECKPOINT, PREVIOUS
from lyra_petsc.output.ordering import FileOrder
from lyra_petsc.parallel import on_root

pytestmark = [pytest.mark.parallel, pytest.mark.quick]

N = 101
X = np.random.default_rng(3).normal(size=(N, 3))


def dealt(comm):
    return np.random.default_rng(5).permutation(N)[comm.rank :: comm.size]


def write(comm, folder, factor=1.0, publish=True, **scalars):
    mine = dealt(comm)
    arrays = {"position": factor * X[mine], "velocity": -factor * X[mine], "term.mark": 2.0 * X[mine]}
    complete = write_checkpoint(folder, FileOrder(comm, mine, N), arrays, {**ENTRIES, **scalars})
    on_root(comm, complete if publish else lambda: None)


def change(comm, work):
    comm.Barrier()
    if comm.rank == 0:
        work()
    comm.Barrier()


def cut(path):
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def flip(path):
    content = bytearray(path.read_bytes())
    place = content.find(X[50].tobytes())
    assert place > 0
    content[place + 3] ^= 16
    path.write_bytes(content)


def test_checkpoints_are_read_with_another_partition(comm, shared_tmp):
    write(comm, shared_tmp)
    mine = np.arange(N)[::-1] if comm.rank == comm.size - 1 else np.arange(0)
    found = read_checkpoint(shared_tmp, FileOrder(comm, mine, N))
    np.testing.assert_array_equal(found.arrays["position"], X[mine])
    np.testing.assert_array_equal(found.arrays["velocity"], -X[mine])
    np.testing.assert_array_equal(found.arrays["term.mark"], 2.0 * X[mine])
    assert found.scalars == ENTRIES
    assert (found.file.name, found.note) == (CHECKPOINT, None)


def test_the_newest_is_read_and_the_previous_one_is_kept(comm, shared_tmp):
    """Also while the next one is written, and if a kill comes between the two renamings."""
    order = FileOrder(comm, dealt(comm), N)
    for step in range(1, 4):
        write(comm, shared_tmp, step, step=step)
        assert read_checkpoint(shared_tmp, order).scalars["step"] == step
    assert sorted(path.name for path in shared_tmp.iterdir()) == [PREVIOUS, CHECKPOINT]
    write(comm, shared_tmp, 4, publish=False, step=4)
    assert read_checkpoint(shared_tmp, order).scalars["step"] == 3
    change(comm, (shared_tmp / CHECKPOINT).unlink)
    stored = read_checkpoint(shared_tmp, order)
    assert stored.scalars["step"] == 2
    np.testing.assert_array_equal(stored.arrays["position"], 2 * X[dealt(comm)])


@pytest.mark.parametrize(
    "damage", [cut, flip, lambda path: path.write_bytes(b"")], ids=["cut", "flip", "empty"]
)
def test_a_damaged_checkpoint_is_replaced_by_the_previous_one(comm, shared_tmp, damage):
    write(comm, shared_tmp, step=1)
    write(comm, shared_tmp, step=2)
    order = FileOrder(comm, dealt(comm), N)
    change(comm, lambda: damage(shared_tmp / CHECKPOINT))
    found = read_checkpoint(shared_tmp, order)
    assert found.scalars["step"] == 1
    assert found.file.name == PREVIOUS
    assert "damaged" in found.note
    assert "\n" not in found.note
    change(comm, lambda: damage(shared_tmp / PREVIOUS))
    with pytest.raises(InputError, match="run without --resume"):
        read_checkpoint(shared_tmp, order)


def test_checkpoints_of_another_mesh_or_missing_ones_are_refused(comm, shared_tmp):
    order = FileOrder(comm, np.arange(comm.rank, N + 1, comm.size), N + 1)
    with pytest.raises(InputError, match="holds no checkpoint"):
        read_checkpoint(shared_tmp, order)
    write(comm, shared_tmp)
    with pytest.raises(InputError, match=f"{N} vertices, the scene's mesh {N + 1}"):
        read_checkpoint(shared_tmp, order)
