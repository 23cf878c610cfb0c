"""The device code: see kernels/README.md. It is imported as wrt.kernels only."""

if __name__ != "wrt.kernels":  # a second copy of a struct type fails at launch, with a message that helps nobody
    raise ImportError("import wrt.kernels, not kernels")
