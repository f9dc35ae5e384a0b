"""The web gateway: a process of its own that puts the API of the daemon before browsers."""
