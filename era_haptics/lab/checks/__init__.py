"""Checks of content and layouts on the plate of a table."""
