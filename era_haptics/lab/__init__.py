"""Measurement, conformance, design and checks. Imports all other packages; none imports it."""
