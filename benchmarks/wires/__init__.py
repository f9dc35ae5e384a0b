"""What each wire costs beside the bare library."""
