"""The method: ASH, Animatable Gaussian Splats (Pang et al., CVPR 2024). Start reading in `ash.model`."""
