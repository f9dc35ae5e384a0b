"""What vibrates: the plate, what it is made of, the ERAs under it and what else touches it."""
