"""What people write: configuration files, values with units, positions and ranges."""
