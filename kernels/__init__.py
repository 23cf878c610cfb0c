"""The device code; kernels/README.md describes it. Import the package as wrt.kernels only."""

if __name__ != "wrt.kernels":  # `kernels` would define each struct type a second time, and launches reject a second type
    raise ImportError(f"the package was imported as {__name__!r}: import wrt.kernels instead")
