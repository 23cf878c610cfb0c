"""Types that many signatures share. They are for annotations: at run time each is `Any`, so that none of them imports Warp.

Write `object` for a value that is only checked, shown or passed on, and a type of one's own module for all else.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import os
    from collections.abc import Sequence
    from typing import Protocol, TypeAlias

    import numpy.typing as npt
    import warp as wp
    from typing_extensions import TypeVar

    class Tensor(Protocol):
        """An array of PyTorch, JAX or another library that shares its memory by DLPack."""

        def __len__(self) -> int: ...
        def __getitem__(self, index: Any, /) -> Any: ...
        def __dlpack__(self, *, stream: Any = ...) -> Any: ...
        def __dlpack_device__(self) -> tuple[Any, int]: ...

    PathLike: TypeAlias = str | os.PathLike[str]
    WarpArray: TypeAlias = wp.array[Any, Any]
    Array: TypeAlias = npt.NDArray[Any] | WarpArray
    ArrayT = TypeVar("ArrayT", bound=Tensor, default=npt.NDArray[Any])  # of answers: NumPy's, Warp's or another library's
    TensorT = TypeVar("TensorT", bound=Tensor)
    NumpyLike: TypeAlias = npt.NDArray[Any] | Sequence[Any]  # what gets answers of NumPy
    ArrayLike: TypeAlias = npt.ArrayLike | WarpArray | Tensor  # what callers give: lists and numbers, too
    Device: TypeAlias = wp.Device  # wp.get_device("cpu"); callers give its name
    Kernel: TypeAlias = wp.Kernel
    DeviceFunction: TypeAlias = wp.Function
    # Warp and readers make these while the program runs, so that no checker knows their fields:
    WarpStruct: TypeAlias = Any  # an instance of a wp.struct
    WarpType: TypeAlias = Any  # wp.float32, wp.vec3, a wp.struct
    KernelModule: TypeAlias = Any  # a module of kernels/ that a structure or a material chooses
    JsonObject: TypeAlias = dict[str, Any]  # a table of a TOML, JSON or glTF file before it is checked
else:
    from typing import TypeVar

    ArrayT, TensorT = TypeVar("ArrayT"), TypeVar("TensorT")
    Tensor = PathLike = WarpArray = Array = NumpyLike = ArrayLike = Device = Kernel = DeviceFunction = Any
    WarpStruct = WarpType = KernelModule = JsonObject = Any
