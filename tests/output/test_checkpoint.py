"""Checkpoints: written, read by other partitions, kept twice, refused."""

import numpy as np
import pytest
from written_run import ENTRIES

from lyra_petsc.errors import InputError
from lyra_petsc.output.checkpoint import CHECKPOINT, NEXT, PREVIOUS, CheckpointWriter, read_checkpoint
from lyra_petsc.output.ordering import FileOrder

pytestmark = [pytest.mark.parallel, pytest.mark.quick]

N = 101
X = np.random.default_rng(3).normal(size=(N, 3))


def dealt(comm):
    return np.random.default_rng(5).permutation(N)[comm.rank :: comm.size]


def writer_of(comm, folder):
    return CheckpointWriter(folder, FileOrder(comm, dealt(comm), N))


def write(comm, folder, factor=1.0, writer=None, **scalars):
    mine = dealt(comm)
    arrays = {"position": factor * X[mine], "velocity": -factor * X[mine], "term.mark": 2.0 * X[mine]}
    (writer or writer_of(comm, folder)).write(arrays, {**ENTRIES, **scalars})


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


@pytest.mark.parametrize("notes", [[], ["x" * 3000]])
def test_the_newest_is_read_and_the_previous_one_is_kept(comm, shared_tmp, notes):
    """Also where the files of earlier ones are used again, if these have the same length."""
    writer, order = writer_of(comm, shared_tmp), FileOrder(comm, dealt(comm), N)
    for step in range(1, 7):
        write(comm, shared_tmp, step, writer, step=step, notes=notes * step)
        assert read_checkpoint(shared_tmp, order).scalars["step"] == step
    assert sorted(path.name for path in shared_tmp.iterdir()) == [PREVIOUS, CHECKPOINT]
    change(comm, (shared_tmp / CHECKPOINT).unlink)
    found = read_checkpoint(shared_tmp, order)
    assert found.scalars["step"] == 5
    np.testing.assert_array_equal(found.arrays["position"], 5 * X[dealt(comm)])


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


def test_a_kill_between_the_two_renamings_loses_nothing(comm, shared_tmp):
    write(comm, shared_tmp, step=1)
    write(comm, shared_tmp, step=2)
    change(comm, lambda: (shared_tmp / PREVIOUS).unlink())
    change(comm, lambda: (shared_tmp / CHECKPOINT).rename(shared_tmp / NEXT))
    assert read_checkpoint(shared_tmp, FileOrder(comm, dealt(comm), N)).scalars["step"] == 2


def test_checkpoints_of_another_mesh_or_missing_ones_are_refused(comm, shared_tmp):
    order = FileOrder(comm, np.arange(comm.rank, N + 1, comm.size), N + 1)
    with pytest.raises(InputError, match="holds no checkpoint"):
        read_checkpoint(shared_tmp, order)
    write(comm, shared_tmp)
    with pytest.raises(InputError, match=f"{N} vertices, the scene's mesh {N + 1}"):
        read_checkpoint(shared_tmp, order)
