"""How bytes get to a far end: pseudo-terminals, and lines that take time and have faults."""
