"""Design: places of actuators for the best promised contrast."""
