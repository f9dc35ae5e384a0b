"""The project's firmware in the place of simulated amplifiers: its samples move the plate."""
