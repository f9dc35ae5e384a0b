"""Measuring plates, actuators and outputs through a sound card."""
