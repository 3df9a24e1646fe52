"""Image files: PNG pictures, contact sheets and films are written, textures and colours are read."""

from __future__ import annotations

import io
import math
import os
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError, OutputError
from lyra_petsc.output.file_operations import open_output, reason, replace_bytes

Image = NDArray[np.uint8]
"""(height, width, 3) red, green, blue."""

TILES = 6
"""Pictures on a contact sheet."""
GAP = 4
"""Pixels between the pictures."""
MIN_PIXELS, MAX_PIXELS = 32, 8192
"""Limits of the width and height of pictures [pixels]."""

PALETTE = (
    "split[a][b];[a]palettegen=stats_mode=diff[p];[b][p]paletteuse=dither=sierra2_4a:diff_mode=rectangle"
)
"""ffmpeg's filter that chooses the 256 colours of a GIF by the film's content."""

FILM_FORMATS: dict[str, tuple[str, str, list[str]]] = {
    ".mp4": ("libx264", "yuv420p", ["-crf", "20", "-preset", "fast", "-movflags", "+faststart"]),
    ".webm": ("libvpx-vp9", "yuv420p", ["-crf", "33", "-b:v", "0", "-cpu-used", "5", "-row-mt", "1"]),
    ".gif": ("gif", "pal8", ["-filter_complex", PALETTE, "-loop", "0"]),
}
"""Codec, pixel format and further options of ffmpeg by file name ending."""


def write_png(path: Path, image: Image) -> None:
    """Write a picture atomically.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    replace_bytes(path, png_bytes(image))


def png_bytes(image: Image) -> bytes:
    """The content of a PNG file of a picture."""
    from PIL import Image as Pictures

    buffer = io.BytesIO()
    Pictures.fromarray(image).save(buffer, format="PNG")
    return buffer.getvalue()


def half_size(image: Image) -> Image:
    """A picture scaled to half its size, for a contact sheet."""
    from PIL import Image as Pictures

    height, width = image.shape[:2]
    half = (max(1, width // 2), max(1, height // 2))
    return np.asarray(Pictures.fromarray(image).resize(half, Pictures.Resampling.LANCZOS))


def contact_sheet(tiles: Sequence[Image]) -> Image:
    """Pictures of equal size, arranged in rows on a white background."""
    columns = math.ceil(math.sqrt(len(tiles)))
    height, width = (size + GAP for size in tiles[0].shape[:2])
    rows = math.ceil(len(tiles) / columns)
    sheet = np.full((rows * height - GAP, columns * width - GAP, 3), 255, dtype=np.uint8)
    for i, tile in enumerate(tiles):
        y, x = height * (i // columns), width * (i % columns)
        sheet[y : y + height - GAP, x : x + width - GAP] = tile
    return sheet


def check_film(path: Path, size: tuple[int, int]) -> None:
    """Check that a film can be written, before anything is drawn.

    Raises
    ------
    InputError
        For an unknown ending, a missing folder, or odd sizes.
    """
    if path.suffix.lower() not in FILM_FORMATS:
        raise InputError(f"a film's name ends in {', '.join(FILM_FORMATS)}, not {path.name!r}", key="--film")
    if path.is_dir():
        raise InputError("is a folder; give the name of a file in it", file=path, key="--film")
    if not path.parent.is_dir():
        raise InputError(f"there is no folder {path.parent}", file=path, key="--film")
    if path.suffix.lower() != ".gif" and (size[0] % 2 or size[1] % 2):
        raise InputError(
            f"{size[0]}x{size[1]}: films need even numbers of pixels ({path.suffix})", key="--size"
        )


@contextmanager
def film_writer(path: Path, size: tuple[int, int], fps: float) -> Iterator[Callable[[Image], None]]:
    """A context that writes a film by ffmpeg; yields a function that adds a frame.

    The file gets its final name at the end of the context; after an exception it is removed.

    Parameters
    ----------
    path : Path
    size : (int, int)
        Width and height [pixels].
    fps : float
        Frames per second.

    Raises
    ------
    OutputError
        If ffmpeg cannot be started or fails; the yielded function raises it, too.
    """
    import imageio_ffmpeg

    # the ending stays last, as ffmpeg chooses the format by it
    part = path.with_name(f".{path.stem}.part{path.suffix.lower()}")
    codec, pixels, options = FILM_FORMATS[path.suffix.lower()]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", "-f", "rawvideo"]
    command += ["-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}", "-r", f"{fps:g}", "-i", "-", "-an"]
    command += ["-c:v", codec, "-pix_fmt", pixels, *options, f"file:{part}"]
    with tempfile.TemporaryFile() as messages:
        try:
            open_output(part).close()  # ffmpeg would follow a link
            # a session of its own, so that Ctrl-C reaches this process alone
            ffmpeg = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=messages, start_new_session=True)
        except OSError as error:
            raise OutputError(f"{path}: cannot be written by ffmpeg: {reason(error)}") from error
        assert ffmpeg.stdin is not None
        pipe = ffmpeg.stdin

        def add(image: Image) -> None:
            try:
                pipe.write(np.ascontiguousarray(image).data)
            except OSError:
                ffmpeg.wait()
                raise failure() from None

        def failure() -> OutputError:
            messages.seek(0)
            lines = messages.read().decode(errors="replace").splitlines()
            # the cause follows the last colon of the first line
            cause = lines[0].rpartition(": ")[2] if lines else "ffmpeg stopped without a message"
            return OutputError(f"{path}: cannot be written: {cause}")

        try:
            try:
                yield add
            except BaseException:
                ffmpeg.kill()
                raise
            finally:
                with suppress(BrokenPipeError):
                    ffmpeg.communicate()
            if ffmpeg.returncode != 0:
                raise failure()
            os.replace(part, path)
        except OSError as error:
            raise OutputError(f"{path}: cannot be written: {reason(error)}") from error
        finally:
            part.unlink(missing_ok=True)


def read_texture(path: Path) -> Image:
    """(h, w, 3) picture from a file, scaled down to at most `MAX_PIXELS` in each direction.

    Raises
    ------
    InputError
        If the file is not a picture.
    """
    from PIL import Image as Pictures
    from PIL import UnidentifiedImageError

    try:
        with Pictures.open(path) as picture:
            picture.thumbnail((MAX_PIXELS, MAX_PIXELS))
            return np.asarray(picture.convert("RGB"))
    except UnidentifiedImageError:
        raise InputError("is not a picture (PNG, JPEG, …)", file=path, key="--texture") from None
    except Pictures.DecompressionBombError:
        raise InputError(
            "is too large; use a picture below 100 megapixels", file=path, key="--texture"
        ) from None
    except (OSError, ValueError, SyntaxError) as error:
        why = reason(error) if isinstance(error, OSError) and error.errno else "damaged"
        raise InputError(f"cannot be read: {why}", file=path, key="--texture") from None


def parse_colors(text: str) -> tuple[str, str]:
    """The two colours of a text ``FRONT,BACK`` as #rrggbb.

    Raises
    ------
    InputError
        If they are not two known colours.
    """
    from PIL import ImageColor

    names = [name.strip() for name in text.split(",")]
    try:
        front, back = ["#{:02x}{:02x}{:02x}".format(*ImageColor.getrgb(name)[:3]) for name in names]
    except ValueError:
        raise InputError(
            f"must be two colours, front and back, as in firebrick,ivory or #c8402f,#f0e2c8, not {text!r}",
            key="--colors",
        ) from None
    return front, back
