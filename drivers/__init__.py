"""Amplifiers: drive commands, the guard, the wire protocol and its backends."""
