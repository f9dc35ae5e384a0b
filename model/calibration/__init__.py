"""Fitting a rig to what was measured on it."""
