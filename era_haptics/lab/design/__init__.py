"""Optimize the positions of actuators for the best promised contrast."""
