"""Amplifiers in operation: commits, watchdog, comparison of replies with what was asked."""
