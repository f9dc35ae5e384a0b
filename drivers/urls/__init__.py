"""Parsers of amplifier URLs, one per wire."""
