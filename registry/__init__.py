"""Shared basics of era-haptics: plug-ins, command line, files, threads, time and limits."""
