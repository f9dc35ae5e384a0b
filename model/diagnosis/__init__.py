"""Whether a rig is what its file says, from what sensors read while its channels are driven."""
