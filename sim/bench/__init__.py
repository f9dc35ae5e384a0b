"""The simulated rig: amplifiers and sensors on one plate, and the amplifiers' devices."""
