"""Time from touch to wire, measured with the real processes."""
