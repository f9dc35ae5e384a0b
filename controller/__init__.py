"""Controller of era-haptics: from touches to commands for amplifiers."""
