"""Finite elements: mesh, matrices, and direct solutions of the plate."""
