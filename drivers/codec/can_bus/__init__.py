"""The CAN codec, the host's side: messages, their PDOs and objects, frames."""
