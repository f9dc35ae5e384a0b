"""The amplifiers' side of every wire: bytes on it, messages behind it."""
