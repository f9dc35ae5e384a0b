"""Discovery of amplifiers that this machine can reach."""
