"""A software amplifier that plays through a sound card."""
