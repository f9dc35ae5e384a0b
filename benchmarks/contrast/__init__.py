"""The benchmark of felt contrast: a data set that others can answer, and its scorer."""
