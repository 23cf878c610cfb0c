"""Optional packages: imported when they are needed. The message about a missing package says how to install it."""

from collections.abc import Iterator
from contextlib import contextmanager

from wrt.core.errors import InputError

# Names of packages that differ from the names of their modules.
INSTALLED_AS = {"OpenImageIO": "openimageio", "PIL": "pillow", "mapbox_earcut": "mapbox-earcut"}
# Modules that only an extra of wrt installs, and the extra; tests/wrt/core/test_packages.py compares with pyproject.toml.
EXTRAS = {"distributed": "cluster", "embreex": "peers", "jax": "jax", "matplotlib": "plots",
          "mitsuba": "peers", "mujoco": "mujoco", "newton": "newton", "pyvista": "pyvista", "torch": "torch",
          "websockets": "viewer"}


@contextmanager
def needed_by(what: str) -> Iterator[None]:
    """Turn a missing module, imported in the block, into an InputError that says what needs it and how to install it."""
    try:
        yield
    except ModuleNotFoundError as error:
        module = (error.name or str(error)).split(".")[0]
        if module == "wrt":
            raise  # a defect of wrt, not a missing package
        extra, package = EXTRAS.get(module), INSTALLED_AS.get(module, module)
        raise InputError(f"{what} needs {module}", hint=f'pip install "wrt[{extra}]"' if extra else f"pip install {package}") from error
