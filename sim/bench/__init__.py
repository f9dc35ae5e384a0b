"""A rig in numbers only: amplifiers on one plate, tied to a clock, and as far ends see them."""
