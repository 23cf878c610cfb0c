"""The renderer, from a scene to a film: kernel features, upload, acceleration structure, kernels, passes, checkpoints, workers."""
