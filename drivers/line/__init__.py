"""The sender of one physical line: the priority queue of its requests."""
