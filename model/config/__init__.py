"""User input: configuration files, values with units, positions and ranges."""
