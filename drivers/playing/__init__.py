"""What channels are to play, and what they play at a time."""
