"""Studies of a table: contrast over the plate, checks against exact plates, export."""
