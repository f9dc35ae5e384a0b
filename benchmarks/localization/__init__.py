"""Contrast and speed of the drive modes, beside other methods and bounds."""
