"""What carries bytes: serial ports of this machine, and TCP connections."""
