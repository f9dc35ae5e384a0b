"""The web gateway: a process that offers the daemon's API and the dashboard to browsers."""
