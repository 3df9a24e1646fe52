"""Films: frames piped to ffmpeg, under their own name only when they are whole."""

from __future__ import annotations

import os
from collections.abc import Generator
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError, OutputError
from lyra_petsc.output.agreement import reason

PALETTE = (
    "split[a][b];[a]palettegen=stats_mode=diff[p];[b][p]paletteuse=dither=sierra2_4a:diff_mode=rectangle"
)
"""GIF has 256 colours: those of this film, chosen by ffmpeg."""

FORMATS: dict[str, tuple[str, str, list[str]]] = {
    ".mp4": ("libx264", "yuv420p", ["-crf", "20", "-preset", "fast", "-movflags", "+faststart"]),
    ".webm": ("libvpx-vp9", "yuv420p", ["-crf", "33", "-b:v", "0", "-cpu-used", "5", "-row-mt", "1"]),
    ".gif": ("gif", "pal8", ["-filter_complex", PALETTE, "-loop", "0"]),
}
"""Codec, pixels and further options of ffmpeg by ending."""


def check_film(path: Path, size: tuple[int, int]) -> None:
    """Refuse a film that cannot be written, before anything is drawn.

    Raises
    ------
    InputError
        Unknown ending, a folder that is not there, odd sizes.
    """
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"a film's name ends in {', '.join(FORMATS)}, not {path.name!r}", key="--film")
    if path.is_dir():
        raise InputError("is a folder; give the name of a file in it", file=path, key="--film")
    if not path.parent.is_dir():
        raise InputError(f"there is no folder {path.parent}", file=path, key="--film")
    if path.suffix.lower() != ".gif" and (size[0] % 2 or size[1] % 2):
        raise InputError(
            f"{size[0]}x{size[1]}: films need even numbers of pixels ({path.suffix})", key="--size"
        )


class Film:
    """A film in the making; use as a context.

    Parameters
    ----------
    path : Path
    size : (int, int)
        Width and height [pixels].
    fps : float
        Frames a second.
    """

    def __init__(self, path: Path, size: tuple[int, int], fps: float) -> None:
        self._path, self._size, self._fps = path, size, fps
        # ffmpeg goes by the ending
        self._part = path.with_name(f".{path.stem}.part{path.suffix.lower()}")
        self._frames: Generator[Any, Any, None] | None = None

    def __enter__(self) -> Film:
        import imageio_ffmpeg

        codec, pixels, options = FORMATS[self._path.suffix.lower()]
        self._frames = imageio_ffmpeg.write_frames(
            str(self._part),
            self._size,
            fps=self._fps,
            codec=codec,
            pix_fmt_out=pixels,
            macro_block_size=1,
            ffmpeg_log_level="error",
            output_params=options,
        )
        self._do(lambda: self._frames.send(None))
        return self

    def add(self, image: NDArray[np.uint8]) -> None:
        """Add a frame (height, width, 3).

        Raises
        ------
        OutputError
            If it cannot be written.
        """
        frame = np.ascontiguousarray(image)
        self._do(lambda: self._frames.send(frame))  # type: ignore[union-attr]

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._do(self._frames.close)  # type: ignore[union-attr]
            if kind is None:
                if not self._part.exists() or self._part.stat().st_size == 0:
                    raise OutputError(f"{self._path}: ffmpeg wrote nothing (disk full?)")
                os.replace(self._part, self._path)
        finally:
            self._part.unlink(missing_ok=True)

    def _do(self, work: Any) -> None:
        try:
            work()
        except (OSError, RuntimeError, StopIteration) as error:
            why = reason(error) if isinstance(error, OSError) and error.errno else _last_line(error)
            raise OutputError(f"{self._path}: cannot be written: {why}") from error


def _last_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else "ffmpeg stopped"
