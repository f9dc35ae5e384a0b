"""Answer queries: choose frequencies and weights for the fingers, and promise levels and
contrasts."""
