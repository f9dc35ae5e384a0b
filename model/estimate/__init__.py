"""Estimates of a plate: which one it is, and how sure that is, from responses."""
