"""The amplifiers' side of CAN: a bus, CANopen nodes on it, and adapters for the host."""
