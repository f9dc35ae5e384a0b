"""Look-up by name: plug-ins of installed packages, and suggestions for mistyped names."""
