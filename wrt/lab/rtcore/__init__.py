"""A model of the RT core: counters of ray costs, caches, warps, machine code, and rays a second."""
