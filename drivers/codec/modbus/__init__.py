"""The Modbus codec, the host's side: messages, their registers, telegrams."""
