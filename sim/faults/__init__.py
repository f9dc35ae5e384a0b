"""What goes wrong with an amplifier and its wire on demand, and when."""
