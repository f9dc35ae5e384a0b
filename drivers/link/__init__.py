"""The link to one amplifier: turns, retries and loss."""
