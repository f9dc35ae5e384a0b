"""A well-behaved Unix process: log, dumps, locks, service manager, children."""
