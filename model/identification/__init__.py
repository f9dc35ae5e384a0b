"""Identification of a rig in place: its parameters and their errors, from measured responses."""
