"""Gaussians: parameters, texels, start and splatting."""
