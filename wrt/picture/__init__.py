"""Films and images: files, tone mapping, metrics, heat maps."""
