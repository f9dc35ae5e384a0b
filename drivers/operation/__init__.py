"""Amplifiers in operation: begun together, looked after, and opened again after a loss."""
