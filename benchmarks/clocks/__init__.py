"""`python -m benchmarks.clocks`: how far apart the clocks of three amplifiers are, by lines."""
