"""What people call by a name: what installed packages add, and which one a mistyped name meant."""
