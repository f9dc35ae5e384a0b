"""CAN buses: frames, the host's side, addresses and adapters."""
