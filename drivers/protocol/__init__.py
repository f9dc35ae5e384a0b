"""The amplifier protocol: messages and numbers, whatever the wire."""
