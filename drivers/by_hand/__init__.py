"""One amplifier by hand: the actions of `era amp`, and an amplifier for scripts."""
