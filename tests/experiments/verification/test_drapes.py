"""Drapes: statistics of their agreement, and friction at the edge of the disc."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from lyra_petsc.experiments import drape
from lyra_petsc.experiments.bench import Bench, Trial
from lyra_petsc.experiments.drape import STARTS
from lyra_petsc.experiments.verification.cases import drapes
from lyra_petsc.stepping.simulation import StepReport


@pytest.mark.parallel(2)
def test_friction_at_the_disc_does_not_throw_vertices_off(
    comm: MPI.Comm, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stretched cloth presses on the disc's edge with a thousand times its weight, and less after sliding.

    Taking back the friction of the higher force once created 0.5 J.
    """
    step, rises = Trial.step, []

    def watched(trial: Trial) -> StepReport:
        x, energy = trial.x, trial.simulation.budget.total
        report = step(trial)
        rises.append(trial.simulation.budget.total - energy)
        assert np.abs(trial.v - (trial.x - x) / report.dt).max() < 0.1
        return report

    monkeypatch.setattr(Trial, "step", watched)
    monkeypatch.setattr(drape, "STEPS", 2)
    with Bench(comm) as bench:
        drapes._drape(bench, "rings", 8, 1)
    assert max(rises) < 0.0


FOLDS = np.random.default_rng(5)


def drawn(mean: float, scatter: float = 0.01) -> list[float]:
    return FOLDS.normal(mean, scatter, STARTS).tolist()


def test_meshes_that_differ_by_chance_pass_and_a_biased_one_fails() -> None:
    alike = [drapes.scatter_of_means([drawn(0.80) for _ in range(4)]) for _ in range(1000)]
    biased = [drapes.scatter_of_means([*(drawn(0.80) for _ in range(3)), drawn(0.84)]) for _ in range(200)]
    assert 0.01 < (np.array(alike) > 1.0).mean() < 0.05
    assert (np.array(biased) > 1.0).mean() > 0.9
