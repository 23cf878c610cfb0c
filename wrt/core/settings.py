"""Settings that every part of wrt shares. The settings of CUDA launches change only the speed; hits and pixels keep their bits."""

import os

VERSION = "0.1.0"  # of wrt: pyproject.toml reads it here
DEFAULT_DEVICE = os.environ.get("WRT_DEVICE") or "cpu"  # of all functions and commands
BLOCK_DIMS = (64, 32, 128, 256)
STACKS = ("local", "shared")  # memory of traversal stacks: the names of kernels.traverse.stack.PLACES

block_dim = BLOCK_DIMS[0]  # threads in a block on a GPU
stack = STACKS[0]  # where bvh2 and the wide BVHs keep the first entries of their traversal stack on a GPU
