"""Meshes as pictures: rasterising and shading."""
