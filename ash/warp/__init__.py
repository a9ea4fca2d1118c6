"""Warp kernels: one source for CUDA devices, and for the processor, where the tests run it."""
