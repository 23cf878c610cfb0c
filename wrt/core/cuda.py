"""How kernels run on CUDA. A setting changes speed alone: hits and pixels have the same bits. Why these are the defaults:
docs/acceleration.md, "Structure and blocks on a GPU"; `wrt.tune` measures the others."""

BLOCK_DIMS = (64, 32, 128, 256)
STACKS = ("shared", "local")  # kernels.traverse.stack.PLACES

block_dim = BLOCK_DIMS[0]  # threads of a block of a launch
stack = STACKS[0]  # where bvh2 and the wide BVHs have the first entries of theirs
