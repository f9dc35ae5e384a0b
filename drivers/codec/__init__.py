"""Codecs between messages and bytes, a package for each kind of wire; no I/O."""
