"""The amplifier protocol: what is said, in which numbers, whatever the wire."""
