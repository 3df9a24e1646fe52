"""Single pictures and the contact sheet."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lyra_petsc.errors import InputError, OutputError
from lyra_petsc.output.agreement import reason

Image = NDArray[np.uint8]

TILES = 6
"""Pictures on a contact sheet."""
COLUMNS = 3
GAP = 4
"""Pixels between them."""
LARGEST_TEXTURE = 4096


def write_png(path: Path, image: Image) -> None:
    """Write a picture (height, width, 3); old or new, never half.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    from PIL import Image as Pictures

    part = path.with_name(f".{path.name}.part")
    try:
        Pictures.fromarray(image).save(part, format="PNG")
        os.replace(part, path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise OutputError(f"{path}: cannot be written: {reason(error)}") from error


def tile(image: Image) -> Image:
    """A picture at half its size."""
    from PIL import Image as Pictures

    height, width = image.shape[:2]
    half = (max(1, width // 2), max(1, height // 2))
    return np.asarray(Pictures.fromarray(image).resize(half, Pictures.Resampling.LANCZOS))


def contact_sheet(tiles: Sequence[Image]) -> Image:
    """The tiles, all of one size, in rows on white."""
    columns = min(COLUMNS, len(tiles))
    rows = math.ceil(len(tiles) / columns)
    height, width = tiles[0].shape[:2]
    sheet = np.full((rows * (height + GAP) - GAP, columns * (width + GAP) - GAP, 3), 255, dtype=np.uint8)
    for i, one in enumerate(tiles):
        row, column = divmod(i, columns)
        y, x = row * (height + GAP), column * (width + GAP)
        sheet[y : y + height, x : x + width] = one
    return sheet


def read_texture(path: Path) -> Image:
    """(h, w, 3) picture from a file, at most 4096 pixels in each direction.

    Raises
    ------
    InputError
        If it is no picture.
    """
    from PIL import Image as Pictures
    from PIL import UnidentifiedImageError

    try:
        with Pictures.open(path) as picture:
            picture.thumbnail((LARGEST_TEXTURE, LARGEST_TEXTURE))
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


def colors_of(text: str) -> tuple[str, str]:
    """Two colours as #rrggbb, from ``FRONT,BACK``.

    Raises
    ------
    InputError
        If they are not two known colours.
    """
    from PIL import ImageColor

    names = [name.strip() for name in text.split(",")]
    try:
        found = ["#{:02x}{:02x}{:02x}".format(*ImageColor.getrgb(name)[:3]) for name in names]
        front, back = found
    except ValueError:
        raise InputError(
            f"must be two colours, front and back, as in firebrick,ivory or #c8402f,#f0e2c8, not {text!r}",
            key="--colors",
        ) from None
    return front, back
