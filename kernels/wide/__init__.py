"""Wide BVHs on rows of lanes: nodes, the walk of one ray, packets of rays."""
