"""Diagnosis of a rig by the responses of sensors to its channels."""
