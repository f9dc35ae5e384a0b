"""Serial lines: frames, the host's side and addresses."""
