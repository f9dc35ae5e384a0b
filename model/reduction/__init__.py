"""Modal reduction of the plate: solved once, then a few dozen coordinates."""
