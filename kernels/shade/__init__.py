"""All work but traversal: cameras, samples, surfaces, materials, lights, shadows, the integrator's step, and the film."""
