"""An amplifier on a serial line, and the line that several share."""
