"""The daemon: drives a plate continuously and serves the API."""
