"""Backends: an amplifier over one kind of wire, a package each."""
