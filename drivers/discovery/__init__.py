"""Which amplifiers can be reached from this machine."""
