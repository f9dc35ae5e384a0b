"""What a bug report should hold, gathered in one file."""
