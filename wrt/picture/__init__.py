"""Films and images: files, tone mapping, error metrics, heat maps."""
