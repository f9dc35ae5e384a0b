"""A plate measured through a sound card: orthogonal multisines out, accelerometers in."""
