"""Touch sources: a file each, found through the entry-point group era_haptics.touch_sources."""
