"""Exchange of rows between the ranks' order and the order of files."""

import numpy as np
import pytest

from lyra_petsc.output.ordering import FileOrder

pytestmark = pytest.mark.parallel(3)


def shuffled(comm, n_global, owners):
    """Shuffled row numbers of a file, distributed to the given ranks only."""
    order = np.random.default_rng(7).permutation(n_global)
    owners = [rank for rank in owners if rank < comm.size] or [0]
    return np.array_split(order, len(owners))[owners.index(comm.rank)] if comm.rank in owners else order[:0]


@pytest.mark.parametrize("owners", [(0, 1, 2), (1,), (0, 2)])
@pytest.mark.parametrize("n_global", [0, 1, 2, 101])
@pytest.mark.parametrize(
    ("shape", "dtype"), [((), np.int64), ((3,), np.float64), ((3, 2), np.float32), ((3,), np.int32)]
)
def test_to_the_order_of_files_and_back(comm, owners, n_global, shape, dtype):
    original = shuffled(comm, n_global, owners)
    plan = FileOrder(comm, original, n_global)
    whole = np.arange(n_global * int(np.prod(shape)), dtype=dtype).reshape(n_global, *shape)
    slab = plan.to_slab(whole[original])
    assert slab.dtype == dtype
    expected = whole[comm.rank * n_global // comm.size : (comm.rank + 1) * n_global // comm.size]
    np.testing.assert_array_equal(slab, expected)
    np.testing.assert_array_equal(plan.from_slab(slab), whole[original])
