"""Simulator of era-haptics: simulated amplifiers on real transports, with a vibrating plate."""
