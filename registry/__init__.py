"""Shared by the packages of era-haptics: plug-ins by name, suggestions for mistyped names."""
