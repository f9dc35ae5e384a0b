"""Interfaces for plug-ins: a module for each kind, named as the group of its entry points.

`wires`, `touch_sources`, `effects`, `content_formats` and `materials` hold what a plug-in of that
kind derives from, takes and gives. The names in their `__all__` stay while the modules behind them
move. Each module brings only what its kind needs, so that a wire does not wait for the plate's
model.
"""
