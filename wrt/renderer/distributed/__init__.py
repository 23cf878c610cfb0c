"""One picture by several workers: GPUs, executors, a Dask cluster."""
