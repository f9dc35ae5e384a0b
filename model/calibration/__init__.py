"""Calibration of a rig by responses measured on it, and the files of measured responses."""
