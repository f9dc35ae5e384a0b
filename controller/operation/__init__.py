"""Whether the plate may play, and who changes that."""
