"""The watchdog: when full steps are no longer accepted without a line search."""

from __future__ import annotations

from collections.abc import Iterable

import pytest
from petsc4py import PETSc

from lyra_petsc.stepping.newton.globalisation import PATIENCE, Watchdog


def seen(energies: Iterable[float]) -> int:
    """Number of iterates with these energies after which full steps end; 0 if they never do."""
    watchdog, u = Watchdog(), PETSc.Vec().createSeq(1)
    watchdog.begin_solve()
    lost = 0
    for number, energy in enumerate(energies, start=1):
        watchdog.note_iterate(u, energy, 1e-14)
        if watchdog.must_return:
            lost = number
            break
    watchdog.begin_solve()
    u.destroy()
    return lost


def test_cycles_of_iterates_end_full_steps() -> None:
    assert 0 < seen([2.0, 1.0] * 20) <= 2 * PATIENCE
    assert 0 < seen([3.0, 2.0, 1.0] * 20) <= 3 * PATIENCE


@pytest.mark.parametrize("energies", [[1.0] * 50, [1.0 / n for n in range(1, 50)], [0.0, 9.0, 4.0, 1.9, 0.9]])
def test_full_steps_continue_while_the_energy_decreases_or_stays(energies: list[float]) -> None:
    assert seen(energies) == 0
