"""Transport of bytes to a far end: pseudo-terminals, and lines with delay and faults."""
