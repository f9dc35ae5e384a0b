"""Import haptic content (AHAP, .haptic, HJIF, WAV) and convert it to stimuli."""
