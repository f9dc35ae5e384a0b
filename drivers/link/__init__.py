"""One link to one amplifier: whose turn it is, what is asked again, and when it is lost."""
