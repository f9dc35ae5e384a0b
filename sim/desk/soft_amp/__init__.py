"""An amplifier made of software: the firmware's core, played by a sound device."""
