"""Types that many signatures share, for annotations alone: at run time each is `Any`, so that this module does not import Warp.

Annotate a value that is only checked, shown or passed on as `object`, and other values with a type of their own module.
"""

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
    NumpyLike: TypeAlias = npt.NDArray[Any] | Sequence[Any]  # arguments of queries that answer in NumPy arrays
    ArrayLike: TypeAlias = npt.ArrayLike | WarpArray | Tensor  # arguments of public functions, also lists and numbers
    Device: TypeAlias = wp.Device  # wp.get_device("cpu"); public functions take its name
    Kernel: TypeAlias = wp.Kernel
    DeviceFunction: TypeAlias = wp.Function
    # Types whose fields are known only at run time:
    WarpStruct: TypeAlias = Any  # An instance of a wp.struct.
    WarpType: TypeAlias = Any  # wp.float32, wp.vec3, a wp.struct.
    KernelModule: TypeAlias = Any  # A module of kernels/ that a structure or a material chooses.
    JsonObject: TypeAlias = dict[str, Any]  # A table of a TOML, JSON or glTF file before it is checked.
else:
    from typing import TypeVar

    ArrayT, TensorT = TypeVar("ArrayT"), TypeVar("TensorT")
    Tensor = PathLike = WarpArray = Array = NumpyLike = ArrayLike = Device = Kernel = DeviceFunction = Any
    WarpStruct = WarpType = KernelModule = JsonObject = Any
