"""The amplifiers' side of every wire."""
