"""Amplifiers in operation: commits, watchdog, comparison of replies with requests."""
