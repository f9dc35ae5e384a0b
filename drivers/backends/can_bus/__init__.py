"""An amplifier as a node of a CAN bus, and the bus that several share."""
