"""Conformance checks, grouped by subject."""
