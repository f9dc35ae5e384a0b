"""Backend for amplifiers on a serial line."""
