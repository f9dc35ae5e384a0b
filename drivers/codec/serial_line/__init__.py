"""Codec of serial lines: messages, payloads, frames."""
