"""Fault injection into amplifiers and wires."""
