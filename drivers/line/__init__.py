"""The sender of one line: the priority queue of its requests."""
