"""Pictures of rays in tiles of 4x4 pixels: a packet of 16 rays then covers a square, and its rays share more nodes than in a row."""

import numpy as np

SIDE = 4  # pixels; 16 rays are a packet (kernels.wide.layout.LANES)
LARGEST = 256  # rows and columns: the rays of larger pictures are so dense that the copies cost more than tiles save


def tiled_width(shape: tuple[int, ...]) -> int:
    """Return the width of small pictures of rays, (..., rows, columns), that consist of whole tiles. Return 0 for all other shapes."""
    return shape[-1] if len(shape) > 1 and all(n % SIDE == 0 and n <= LARGEST for n in shape[-2:]) else 0


def copy_to_tiles(tiles: np.ndarray, rows: np.ndarray, width: int) -> None:
    """Copy contiguous pixels from rows of pictures to tiles: both (N, ...) of one dtype, and N a multiple of SIDE * width."""
    _pieces(tiles, -1, width // SIDE, SIDE)[...] = _pieces(rows, -1, SIDE, width // SIDE).swapaxes(1, 2)


def copy_from_tiles(rows: np.ndarray, tiles: np.ndarray, width: int) -> None:
    """Copy pixels from tiles back to rows of pictures. Arguments: see `copy_to_tiles`."""
    _pieces(rows, -1, SIDE, width // SIDE)[...] = _pieces(tiles, -1, width // SIDE, SIDE).swapaxes(1, 2)


def _pieces(pixels: np.ndarray, *shape: int) -> np.ndarray:
    """View pixels (N, ...) as pieces of SIDE pixels, which NumPy copies as one item each."""
    return pixels.reshape(-1).view(f"V{SIDE * pixels[:1].nbytes}").reshape(shape)
