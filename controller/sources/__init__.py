"""Touch sources: a file each, found by the scheme of their URL."""
