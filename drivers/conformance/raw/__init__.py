"""Raw access to the line of an amplifier under test: frames as no backend would send them."""
