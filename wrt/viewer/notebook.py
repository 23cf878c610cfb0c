"""Pictures side by side, as a notebook shows them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from wrt.core.errors import InputError
from wrt.core.packages import needed_by
from wrt.picture.film import Film

if TYPE_CHECKING:
    from PIL import Image

TITLE, GAP = 22, 8  # pixels: height of a title above a picture, and space between pictures


def side_by_side(pictures: Mapping[str, Film | np.ndarray], columns: int = 2, scale: int = 1) -> Image.Image:
    """Return an image of several pictures in rows, with a title above each picture.

    Parameters
    ----------
    pictures
        Pictures by title ("": no title). A picture is a Film or an array of display codes (H, W, 3) uint8.
    columns
        Number of pictures in a row.
    scale
        Size of each pixel in the image, in pixels along each side.

    Returns
    -------
    PIL.Image.Image
        An RGB image, which a notebook shows.

    Raises
    ------
    InputError
        If there is no picture, or an array has another shape or dtype.
    """
    with needed_by("a notebook's picture"):
        from PIL import Image, ImageDraw

    from wrt.picture.heatmap import INK, font

    if not pictures or columns < 1 or scale < 1:
        raise InputError("side_by_side needs at least one picture, and columns and scale of 1 or more")
    codes = [each.to_srgb8() if isinstance(each, Film) else np.asarray(each) for each in pictures.values()]
    for name, array in zip(pictures, codes, strict=True):
        if array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] != 3:
            raise InputError(f"must be a Film or (H, W, 3) uint8, got {array.shape} {array.dtype}", argument=name)
    columns = min(columns, len(codes))
    width, height = (scale * max(array.shape[axis] for array in codes) for axis in (1, 0))
    rows = -(-len(codes) // columns)
    title = TITLE if any(pictures) else 0
    image = Image.new("RGB", (columns * (width + GAP) - GAP, rows * (title + height + GAP) - GAP), "white")
    canvas = ImageDraw.Draw(image)
    for i, (name, array) in enumerate(zip(pictures, codes, strict=True)):
        x, y = i % columns * (width + GAP), i // columns * (title + height + GAP)
        canvas.text((x, y + TITLE // 2), name, fill=INK, font=font(13), anchor="lm")
        image.paste(Image.fromarray(array.repeat(scale, axis=0).repeat(scale, axis=1)), (x, y + title))
    return image
