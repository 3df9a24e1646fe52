"""What the user asked of a study, as it is kept in its folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lyra_petsc.errors import InputError
from lyra_petsc.experiments import records
from lyra_petsc.experiments.study.combination import scene_of
from lyra_petsc.output.agreement import reason
from lyra_petsc.scene.schema import Scene

REQUEST_FILE = "request.json"


@dataclass(frozen=True)
class Request:
    """A study as asked for.

    Attributes
    ----------
    scene : str
        Path of the scene.
    settings : tuple of str
        ``--set``.
    vary : tuple of str
        ``--vary``; empty: the default sweep.
    reference : str
        ``auto``, ``exact:NAME`` or ``run:DIR``.
    quantities : str
        Separated by commas; empty: all.
    repeats : int
        How often each combination is timed.
    ranks : int or None
        ``--ranks``: one mpirun per case; None: the communicator the study was started with.
    trust_mesh : bool
        ``--trust-mesh``.
    """

    scene: str
    settings: tuple[str, ...] = ()
    vary: tuple[str, ...] = ()
    reference: str = "auto"
    quantities: str = ""
    repeats: int = 3
    ranks: int | None = None
    trust_mesh: bool = False

    def with_changes(self, overrides: Sequence[str]) -> Scene:
        """The scene with its settings and further overrides.

        Raises
        ------
        InputError
            If they do not go together.
        """
        return scene_of(Path(self.scene), self.settings, overrides, trust_mesh=self.trust_mesh)


def read_request(folder: Path) -> Request:
    """The request that a study's folder was begun with.

    Raises
    ------
    InputError
        If there is none, or it cannot be read.
    """
    path = folder / REQUEST_FILE
    try:
        return records.load(path, Request)
    except OSError as error:
        raise InputError(f"cannot be read: {reason(error)}", file=path, key="--resume") from None
    except ValueError:
        raise InputError("is damaged; begin the study anew with --force", file=path, key="--resume") from None
