"""Rigs: from the rig file to the values used by the model."""
