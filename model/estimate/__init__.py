"""Estimate plate parameters and their uncertainty from measured responses."""
