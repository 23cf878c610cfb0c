"""The SM's work: camera, samples, surfaces, materials, lights, shadows, the integrator's step, the film."""
