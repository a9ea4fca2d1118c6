"""C++17 kernels and the way to them."""
