"""Virtual accelerometers, recordings, and measures of their signals."""
