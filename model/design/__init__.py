"""Places of ERAs that give the best promised felt contrast over a distribution of contacts."""
