"""Rivals and measurements: speed is reported with the error beside it."""
