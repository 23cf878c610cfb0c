"""Read the metadata that wrt writes to picture files with independent readers: Pillow and OpenImageIO."""

from __future__ import annotations

from pathlib import Path

import OpenImageIO as oiio
from PIL import Image

from wrt.picture.image import METADATA_PREFIX


def read_metadata(path: str | Path) -> dict[str, str]:
    """Return wrt's metadata: text by key, without the prefix."""
    suffix = Path(path).suffix.lower()
    if suffix == ".png":
        with Image.open(path) as picture:
            pairs = [(key, str(value)) for key, value in picture.info.items()]
    else:
        source = oiio.ImageInput.open(str(path))
        pairs = [(entry.name, str(entry.value)) for entry in source.spec().extra_attribs]
        source.close()
    return {key.removeprefix(METADATA_PREFIX): value for key, value in pairs if key.startswith(METADATA_PREFIX)}
