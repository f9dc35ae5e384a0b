"""The amplifier protocol without I/O: bytes in, messages out."""
