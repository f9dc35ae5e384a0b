"""Kinds of wire by the scheme of a URL: a file each, and a line in `drivers.wires.wire`."""
