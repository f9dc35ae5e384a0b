"""The simulated amplifier: states, playback of channels, temperature."""
