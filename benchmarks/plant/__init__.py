"""Speed of the plate in time, and a picture of it."""
