"""Identification of a rig in place: parameters from responses at its ERAs, and their errors."""
