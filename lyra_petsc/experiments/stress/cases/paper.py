"""The paper scene: at the same Δt its kinetic energy errs by no more than that of soft cloth.

The scene is chaotic; its converged value and what single correct calculations are apart are those of an
ensemble of 18 explicit fourth-order calculations (scripts/references/paper.py). Soft cloth is the same sheet
with a thousandth of the stiffness, its converged value that of a second-order integrator with a quarter of
the Δt. Both are stepped by backward Euler, whose error stands clear of the scatter of single calculations.
"""

from __future__ import annotations

from collections.abc import Mapping

from lyra_petsc.experiments.bench import Bench, Trial
from lyra_petsc.experiments.case import Verdict
from lyra_petsc.experiments.stress.step_balance import Record
from lyra_petsc.experiments.stress.stress_scenes import (
    FULL,
    USUAL,
    Content,
    Scope,
    Setting,
    StressCase,
    family,
    scale,
)
from lyra_petsc.parallel import on_root
from lyra_petsc.scene.dump import dump_scene
from lyra_petsc.scene.load import default_scene, load_scene
from lyra_petsc.scene.text import parse_yaml

KINETIC, SPREAD = 0.4646114, 0.0030549
"""Mean and standard deviation of the ensemble at the end, J."""

END = 0.48
"""s"""

SOFTER, FINER, SHARPER = 1e-3, 4, "bdf2"


def _paper(bench: Bench, integrator: str) -> Content:
    def read() -> Content:
        scene = load_scene(default_scene().with_name("paper.yaml"), (f"time.integrator={integrator}",))
        understood: Content = parse_yaml(dump_scene(scene), file=None)
        return understood

    content = on_root(bench.comm, read)
    content.pop("output")
    return content


def _kinetic(trial: Trial) -> float:
    return trial.simulation.budget.kinetic


def _soft(bench: Bench, integrator: str, step: float) -> float:
    """Kinetic energy [J] of the soft sheet at the end."""
    content = scale(_paper(bench, integrator), stretching=SOFTER)
    content["time"] |= {"step": step, "end": END}
    with bench.simulation(content) as trial:
        return _kinetic(trial.run())


def _case(step: float, level: Scope) -> StressCase:
    def judge(setting: Setting, bench: Bench, record: Record) -> Mapping[str, Verdict]:
        error = abs(record.observed[-1] / KINETIC - 1.0)
        converged = _soft(bench, SHARPER, step / FINER)
        soft = abs(_soft(bench, "beuler", step) / converged - 1.0)
        allowed = soft + 2.0 * SPREAD / KINETIC
        words = (
            f"kinetic energy off by {100 * error:.2g} %, that of soft cloth by {100 * soft:.2g} %, two "
            f"standard deviations of correct calculations are {200 * SPREAD / KINETIC:.2g} %"
        )
        return {"kinetic energy": Verdict(error <= allowed, words)}

    return StressCase(
        f"paper-{step * 1e3:g}ms",
        f"the paper scene, Δt {step * 1e3:g} ms",
        lambda setting, bench: _paper(bench, "beuler"),
        steps=round(END / step),
        step=step,
        level=level,
        own=True,
        observe=_kinetic,
        judge=judge,
    )


paper = family(
    "paper",
    "the paper scene against its converged kinetic energy, as soft cloth against its own",
    _case(0.01, FULL),
    _case(0.005, USUAL),
    _case(0.0025, FULL),
)
