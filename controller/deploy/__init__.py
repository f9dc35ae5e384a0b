"""What a machine needs to run the daemon as a service of the system."""
