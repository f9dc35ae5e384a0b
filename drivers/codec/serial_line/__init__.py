"""The serial wire's codec: messages, their payloads, frames."""
