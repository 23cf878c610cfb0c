"""From a scene to a film: features, upload, structure, kernels, tiles and passes, checkpoints, workers."""
