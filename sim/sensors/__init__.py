"""Virtual accelerometers, recordings of what they read, and what their signals say."""
