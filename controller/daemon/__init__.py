"""The daemon: one process with the control loop and the drivers, told what to do over its API."""
