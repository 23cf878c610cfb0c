"""What the SM does: camera, samples, surfaces, materials, lights, shadows, the integrator, the picture."""
