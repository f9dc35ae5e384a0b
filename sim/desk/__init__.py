"""A sound card as amplifier and as instrument."""
