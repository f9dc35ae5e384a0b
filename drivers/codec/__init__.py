"""Messages to bytes and back, a package for each kind of wire; without I/O."""
