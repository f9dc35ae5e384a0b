"""Amplifiers in operation: begun together, and looked after."""
