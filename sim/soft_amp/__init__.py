"""An amplifier made of software, played by a sound device."""
