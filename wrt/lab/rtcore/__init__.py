"""The cost of rays on an RT core: counters, caches, warps, machine code, and a model of rays a second."""
