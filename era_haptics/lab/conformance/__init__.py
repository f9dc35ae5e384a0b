"""Conformance: whether an amplifier does what protocol 4 demands."""
