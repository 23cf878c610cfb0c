"""Measurements of wrt and of other libraries; reports show speed together with error."""
