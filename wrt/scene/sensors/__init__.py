"""Sensors as arrays of rays: poses, cameras with lens distortion, LiDARs, noise. `wrt.sensors` has the public names."""
