"""The simulated rig: amplifiers on one plate, their clock, and their devices."""
