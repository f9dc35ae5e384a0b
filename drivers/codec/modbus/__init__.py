"""Codec of Modbus for the host: messages, registers, ADUs."""
