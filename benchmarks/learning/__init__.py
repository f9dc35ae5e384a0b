"""How soon answers follow a measured pattern."""
