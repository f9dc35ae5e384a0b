"""The simulation as a process: run loop, live view and shutdown."""
