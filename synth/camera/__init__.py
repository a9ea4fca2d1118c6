"""Cameras, light and the path tracer."""
