"""What the SM does: camera, samples, surfaces, materials, lights, shadows, the integrator's step, the film."""
