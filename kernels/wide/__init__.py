"""Wide BVHs, whose nodes have 4 or 8 children: nodes, traversal for one ray, packets of rays. Boxes and triangles are tested in rows."""
