"""The link to one amplifier: priorities, retries and loss."""
