"""Inner loops of the builders: most run on the host, lbvh, fit and shape on any device."""
