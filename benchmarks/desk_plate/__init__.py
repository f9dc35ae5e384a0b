"""A plate on a desk without hardware: its own model in time, behind a simulated sound card."""
