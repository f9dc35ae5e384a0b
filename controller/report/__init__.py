"""What a bug report should hold, gather_all in one file."""
