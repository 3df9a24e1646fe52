"""What to change about a run that was slow or inaccurate, as its history tells."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from lyra_petsc.show.report.numbers import percent, seconds, short
from lyra_petsc.show.report.run_facts import Facts

MANY_REJECTED = 0.05
"""Rejected attempts over accepted steps."""

MANY_NEWTON = 8.0
"""Newton iterations of a step, on average."""

MANY_LINEAR = 100.0
"""Linear iterations of a Newton iteration, on average."""

MUCH_OUTPUT = 0.2
MUCH_MESHING = 0.25
"""Shares of the wall time."""

FEW_VERTICES = 300
"""Of a rank."""

LOSSY = 0.05
"""Energy lost by the time scheme over what moved."""

SLOW_FIRST_STEP = 5.0
"""Seconds that the first step takes longer than the median."""

OPTIONS = {
    "block-jacobi": "-pc_type pbjacobi",
    "ilu": "-pc_type ilu",
    "block-ilu": "-pc_type bjacobi -sub_pc_type ilu",
    "multigrid": "-pc_type python",
    "multigrid-w": "-pc_type python -pc_mg_w_from 2",
    "gamg": "-pc_type gamg",
    "direct": "-pc_type cholesky",
    "cholesky": "-pc_type cholesky",
}
"""What to write on the command line for each linear solver; the program adds what goes with it."""

Rule = Callable[[Facts], Iterator[str]]


def advice(facts: Facts) -> list[str]:
    """Sentences, each with what was seen and what to change; empty if nothing stands out."""
    return [words for rule in RULES for words in rule(facts)]


def _how_it_ended(facts: Facts) -> Iterator[str]:
    folder = facts.run.folder
    again = f"mpirun -n {facts.summary.get('ranks', 1)} lyra-petsc run --resume --out {folder}"
    if facts.failed:
        for hint in facts.summary["failure"].get("advice", []):
            yield f"The solver stopped. Try {hint}."
    elif facts.outcome == "killed":
        yield f"The run was killed before its end. It goes on from the newest checkpoint with: {again}"
    elif facts.outcome not in ("done", "running", "unknown"):
        yield f"The run was stopped before its end. It goes on with: {again}"


def _rejected_steps(facts: Facts) -> Iterator[str]:
    if facts.n_steps == 0 or facts.rejected <= MANY_REJECTED * facts.n_steps:
        return
    seen = f"{facts.rejected} attempts at a step were rejected over {facts.n_steps} accepted steps"
    time, usual = facts.run.scene.time, float(np.median(facts.steps("dt")))
    if time.adaptive:
        yield f"{seen}: each costs a solve. A larger time.tolerance rejects fewer."
    elif facts.static:
        yield f"{seen}. A smaller time.step (first increment of the load factor) saves the attempts."
    elif usual < 0.99 * float(time.step):
        yield f"{seen}. Set time.step to {short(usual)} s, the median of the steps that were accepted."
    else:
        yield f"{seen}, a few hard moments of the motion. time.step: auto takes small steps only there."


def _taken_over(facts: Facts) -> Iterator[str]:
    changed = [note for note in facts.summary.get("notes", []) if "going on with" in note]
    name = facts.summary.get("linear_solver", "")
    if changed and name in OPTIONS:
        yield (
            f"The linear solver was changed during the run ({changed[-1]}). To start with it: "
            f"{OPTIONS[name]}, or the same in the scene's petsc block."
        )


def _newton(facts: Facts) -> Iterator[str]:
    mean = facts.newton_per_step
    if facts.static or mean <= MANY_NEWTON:
        return
    yield (
        f"A step takes {short(mean)} Newton iterations on average. A smaller time.step needs fewer; so does "
        "more material.damping, if the material allows it. "
        "lyra-petsc study SCENE finds the Δt and the integrator that give an accuracy in the least time."
    )


def _linear(facts: Facts) -> Iterator[str]:
    mean = facts.linear_per_newton
    if mean <= MANY_LINEAR:
        return
    used = str(facts.summary.get("linear_solver", ""))
    incomplete = "ilu" if facts.summary.get("ranks", 1) == 1 else "block-ilu"
    tries = "; ".join(
        OPTIONS[name] for name in (incomplete, "multigrid", "direct") if not used.startswith(name)
    )
    yield (
        f"A Newton iteration takes {short(mean)} linear iterations on average with '{used}'. Try, comparing "
        f"wall times: {tries}; or a looser -ksp_rtol."
    )


def _output(facts: Facts) -> Iterator[str]:
    share = facts.share("output")
    if share > MUCH_OUTPUT:
        yield (
            f"Writing took {percent(share)} of the wall time. A longer output.every and fewer output.fields "
            "write less."
        )


def _meshing(facts: Facts) -> Iterator[str]:
    share = facts.share("mesh")
    if share > MUCH_MESHING and facts.phases["mesh"] > 1.0:
        made = any(source.file and source.file.suffix.lower() == ".geo" for source in facts.run.scene.mesh)
        remedy = " Mesh the .geo once (gmsh -2 FILE.geo) and name the .msh in the scene." if made else ""
        yield f"Reading the mesh took {percent(share)} of the wall time.{remedy}"


def _compilation(facts: Facts) -> Iterator[str]:
    wall = facts.steps("wall_seconds")
    if len(wall) < 3:
        return
    first, usual = float(wall[0]), float(np.median(wall))
    if first - usual > SLOW_FIRST_STEP:
        yield (
            f"The first step took {seconds(first)}, a later one {seconds(usual)}: kernels were compiled. The "
            "next run loads them."
        )


def _ranks(facts: Facts) -> Iterator[str]:
    ranks, vertices = facts.summary.get("ranks", 1), len(facts.run.rest)
    if ranks > 1 and vertices < FEW_VERTICES * ranks:
        yield (
            f"{ranks} ranks share {vertices} vertices, {vertices // ranks} each: too few to pay. "
            "Try fewer ranks."
        )


def _accuracy(facts: Facts) -> Iterator[str]:
    time = facts.run.scene.time
    error, tolerance = facts.summary.get("estimated_error"), time.tolerance
    if error is not None and tolerance is not None and error > tolerance:
        yield (
            f"The estimated error of the positions, {short(error)} of the sheet's size, is beyond "
            f"time.tolerance, {short(tolerance)}: a smaller -ts_adapt_dt_min lets the steps follow it."
        )
    if facts.static or facts.turnover == 0.0 or time.scheme not in ("beuler", "semi-implicit"):
        return
    lost = float(facts.scheme_loss[-1])
    if lost > LOSSY * facts.turnover:
        yield (
            f"The time scheme ({time.scheme}) took away {short(lost)} J, {percent(lost / facts.turnover)} of "
            "the largest change of an energy. A smaller time.step loses less, and so do bdf2, midpoint and "
            "alpha2 as time.integrator."
        )


RULES: tuple[Rule, ...] = (
    _how_it_ended,
    _rejected_steps,
    _taken_over,
    _newton,
    _linear,
    _output,
    _meshing,
    _compilation,
    _ranks,
    _accuracy,
)
