"""Basics that all packages share, such as plug-ins by name and suggestions for typing errors."""
