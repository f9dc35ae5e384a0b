"""Shared by drivers and model: plug-ins by name, suggestions for mistyped names, and limits."""
