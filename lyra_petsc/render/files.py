"""Where the images go as they come: pictures, film, contact sheet."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.render.film import Film
from lyra_petsc.render.plan import Plan
from lyra_petsc.render.stills import contact_sheet, tile, write_png

Image = NDArray[np.uint8]


class PictureFiles:
    """All files of a plan, fed with the images of its states in ascending order; use as a context.

    Parameters
    ----------
    plan : Plan
    """

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._film: Film | None = None
        self._tiles: list[Image] = []
        self._frames_left = list(plan.film[1].states) if plan.film else []
        self._open = ExitStack()
        self.written: list[Path] = []

    def __enter__(self) -> PictureFiles:
        if self._plan.film is not None:
            path, timing = self._plan.film
            self._film = self._open.enter_context(Film(path, self._plan.size, timing.fps))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.__exit__(kind, error, trace)

    def take(self, state: int, image: Image) -> None:
        """Use the image (height, width, 3) of a state wherever it belongs.

        Raises
        ------
        OutputError
            If it cannot be written.
        """
        for path, shown in self._plan.pictures:
            if shown == state:
                write_png(path, image)
                self.written.append(path)
        while self._film is not None and self._frames_left and self._frames_left[0] == state:
            self._film.add(image)
            self._frames_left.pop(0)
        if self._plan.sheet is not None and state in self._plan.sheet[1]:
            self._tiles.append(tile(image))

    def finish(self) -> list[Path]:
        """Write what needs all images; what was written.

        Raises
        ------
        OutputError
            If it cannot be written.
        """
        if self._plan.sheet is not None:
            write_png(self._plan.sheet[0], contact_sheet(self._tiles))
            self.written.append(self._plan.sheet[0])
        if self._plan.film is not None:
            self._open.close()
            self.written.append(self._plan.film[0])
        return self.written
