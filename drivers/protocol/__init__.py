"""The amplifier protocol: messages and numbers, independent of the wire."""
