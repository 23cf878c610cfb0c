"""The decorator `lanes_kernel`, for CPU kernels that call the vectorised C++ functions of this folder's headers.

A header implements functions of the Python file of the same name. A C++ function and its Python function have one name and return
the same bits (tests/kernels/shade/test_twins.py)."""

from functools import partial
from typing import TYPE_CHECKING

from wrt.kernels import structs
from wrt.kernels.headers import constants, with_headers
from wrt.kernels.shade import sampling, textures

LAYOUT_H = constants({name: getattr(sampling, name) for name in (
    "LANES", "HASH_1", "HASH_2", "LK_1", "LK_2", "LK_3", "SEED_X", "SEED_Y", "BITS_1", "BITS_2", "BITS_4", "BITS_8", "UNIT")} | {
        name: getattr(textures, name) for name in ("FARTHEST", "WRAP_REPEAT", "WRAP_CLAMP", "WRAP_MIRROR")})
HEADERS = ("shade/sampling.h", "shade/textures.h", "shade/backgrounds.h", "shade/film.h")

if TYPE_CHECKING:
    from typing import no_type_check as lanes_kernel
else:
    lanes_kernel = partial(structs.kernel, extra_build_options=with_headers(*HEADERS, layout=LAYOUT_H))
