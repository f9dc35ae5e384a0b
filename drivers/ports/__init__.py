"""Serial ports of this machine, for every wire that is one."""
