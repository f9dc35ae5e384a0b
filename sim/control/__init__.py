"""Control of a running simulation over a socket: fingers, sensors, faults and time."""
