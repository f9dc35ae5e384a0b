"""Steady vibration: what drives the plate, and how strongly it then moves where."""
