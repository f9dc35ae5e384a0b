"""Checks of conformance, by what they ask of an amplifier."""
