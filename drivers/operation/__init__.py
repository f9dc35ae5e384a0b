"""Amplifiers in operation: synchronized commits, watchdog and read-back."""
