"""What a set takes in the host."""
