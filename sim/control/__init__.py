"""Control of a running far end from outside: fingers, sensors, faults and time, over a socket."""
