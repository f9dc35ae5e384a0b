"""Amplifiers of voltage: motion above, voltage below, converted just before the codec."""

from drivers.voltage.backend import VoltageBackend

__all__ = ["VoltageBackend"]
