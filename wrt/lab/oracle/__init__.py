"""What a ray hits, in float64 and exact arithmetic, with the bounds that float32 answers are held to."""
