"""Backends: a package for each kind of wire."""
