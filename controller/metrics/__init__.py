"""What the daemon counts, for Prometheus: a process of its own, a client of the API."""
