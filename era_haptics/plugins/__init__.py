"""Interfaces for plug-ins, one module per kind, named like the entry point group.

`wires`, `touch_sources`, `effects`, `content_formats` and `materials` contain the base classes and
types that a plug-in of that kind needs, and nothing else, so that a wire does not load the plate
model. The names in their `__all__` are stable; the modules behind them can change.
"""
