"""Places of ERAs that give the best robust felt contrast over a distribution of contacts."""
