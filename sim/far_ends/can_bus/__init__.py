"""The amplifiers' side of CAN: a bus, CANopen nodes and adapters."""
