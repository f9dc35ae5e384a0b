"""Design studies: which layout, how many ERAs, how stiff, over as many layouts as asked."""
