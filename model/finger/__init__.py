"""A finger on the plate: where it touches, how it loads, what it feels and what tells it apart."""
