"""A well-behaved Unix process: log, locks, service manager, children."""
