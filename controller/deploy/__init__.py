"""Install the daemon as a system service."""
