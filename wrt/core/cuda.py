"""Settings of CUDA launches. They change only the speed; hits and pixels keep their bits."""

BLOCK_DIMS = (64, 32, 128, 256)
STACKS = ("local", "shared")  # memory of traversal stacks: the names of kernels.traverse.stack.PLACES

block_dim = BLOCK_DIMS[0]  # threads in a block
stack = STACKS[0]  # where bvh2 and the wide BVHs keep the first entries of their traversal stack
