"""Finite elements: the plate on a mesh, its matrices, and direct answers from them."""
