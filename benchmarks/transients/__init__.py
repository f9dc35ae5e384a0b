"""Shaped onsets and endings beside plain ramps."""
