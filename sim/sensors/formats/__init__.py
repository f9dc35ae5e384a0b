"""Recordings as files, a kind of file each."""
