"""The plate in its modes: solved once, then answered for in a few dozen coordinates."""
