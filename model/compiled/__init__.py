"""C kernels for batches of small matrices, each with a NumPy reference implementation."""
