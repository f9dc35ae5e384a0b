"""The same plate solved by another program."""
