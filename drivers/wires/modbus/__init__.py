"""Modbus, RTU and TCP: frames, the host's side and addresses."""
