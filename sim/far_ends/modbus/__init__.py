"""The amplifiers' side of Modbus, written apart from the host's: the two check each other."""
