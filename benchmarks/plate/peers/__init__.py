"""The same plate solved by other programs."""
