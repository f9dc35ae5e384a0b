"""Where an amplifier is: the URLs of every wire, taken apart."""
