"""lyra_petsc: parallel thin-shell simulation on PETSc.

    >>> import lyra_petsc
    >>> scene = lyra_petsc.load("configs/flag.yaml", {"time.end": 1.0})
    >>> run = lyra_petsc.run(scene, "runs/flag")
    >>> run.positions[-1], run.history

``docs/python.md`` has more. Nothing heavy is imported, and neither MPI nor PETSc started, before a name is
used that needs it; `load` and `Run` need neither.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from lyra_petsc.api.scenes import load
    from lyra_petsc.api.simulations import Simulation, Step
    from lyra_petsc.errors import InputError, LyraError, OutputError, SolverError
    from lyra_petsc.experiments.fit.fit_runner import fit, gradient
    from lyra_petsc.scene.schema import Scene
    from lyra_petsc.show.notebook import Run, run

__all__ = [
    "InputError",
    "LyraError",
    "OutputError",
    "Run",
    "Scene",
    "Simulation",
    "SolverError",
    "Step",
    "__version__",
    "fit",
    "gradient",
    "load",
    "run",
]

_HOMES = {
    "InputError": "errors",
    "LyraError": "errors",
    "OutputError": "errors",
    "SolverError": "errors",
    "Run": "show.notebook",
    "Scene": "scene.schema",
    "Simulation": "api.simulations",
    "Step": "api.simulations",
    "fit": "experiments.fit.fit_runner",
    "gradient": "experiments.fit.fit_runner",
    "load": "api.scenes",
    "run": "show.notebook",
}


def __getattr__(name: str) -> Any:
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{home}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
