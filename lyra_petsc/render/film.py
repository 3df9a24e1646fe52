"""Films: frames piped to ffmpeg, under their own name only when they are whole."""

from __future__ import annotations

import os
import subprocess
import tempfile
from contextlib import suppress
from pathlib import Path
from types import TracebackType

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
        self._ffmpeg: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Film:
        import imageio_ffmpeg

        codec, pixels, options = FORMATS[self._path.suffix.lower()]
        width, height = self._size
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error"]
        command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{self._fps:g}"]
        command += ["-i", "-", "-an", "-c:v", codec, "-pix_fmt", pixels, *options, f"file:{self._part}"]
        self._words = tempfile.TemporaryFile()
        try:
            # in a session of its own: Ctrl-C is for us, who then end it
            self._ffmpeg = subprocess.Popen(
                command, stdin=subprocess.PIPE, stderr=self._words, start_new_session=True
            )
        except OSError as error:
            self._words.close()
            raise OutputError(f"{self._path}: ffmpeg cannot be started: {reason(error)}") from error
        return self

    def add(self, image: NDArray[np.uint8]) -> None:
        """Add a frame (height, width, 3).

        Raises
        ------
        OutputError
            If it cannot be written.
        """
        assert self._ffmpeg is not None
        assert self._ffmpeg.stdin is not None
        try:
            self._ffmpeg.stdin.write(np.ascontiguousarray(image).data)
        except OSError:
            self._ffmpeg.wait()
            raise self._failure() from None

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._ffmpeg is None:
            return
        try:
            if kind is not None:
                self._ffmpeg.kill()
            with suppress(BrokenPipeError):
                self._ffmpeg.communicate()
            if kind is None:
                if self._ffmpeg.returncode != 0:
                    raise self._failure()
                os.replace(self._part, self._path)
        except OSError as problem:
            raise OutputError(f"{self._path}: cannot be written: {reason(problem)}") from problem
        finally:
            self._words.close()
            self._part.unlink(missing_ok=True)

    def _failure(self) -> OutputError:
        self._words.seek(0)
        said = self._words.read().decode(errors="replace").splitlines()
        # the cause stands behind the last colon of the first line
        why = said[0].rpartition(": ")[2] if said else "ffmpeg stopped without a word"
        return OutputError(f"{self._path}: cannot be written: {why}")
