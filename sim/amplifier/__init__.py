"""The simulated amplifier: its states, what its channels play, how warm it is."""
