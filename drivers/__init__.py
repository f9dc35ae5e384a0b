"""Drivers of era-haptics: protocol, wires and command limits of amplifiers."""
