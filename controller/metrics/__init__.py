"""Prometheus metrics of the daemon: a process of its own, a client of the API."""
