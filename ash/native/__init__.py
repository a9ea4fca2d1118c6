"""C++17 kernels, and the nodes of torch's graph that call them."""
