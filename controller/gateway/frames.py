"""Heads of the frames that a WebSocket client sends, checked for what aiohttp does not bound."""

import asyncio

from controller.process.rate_limit import RateLimiter

MAX_FRAGMENTS = 64  # per message; a browser sends 64 KiB in one or two
MAX_CONTROL_RATE = 100.0  # 1/s; pings and pongs of one WebSocket; one in ten seconds is needed
_LENGTH_BYTES = {126: 2, 127: 8}  # that follow the first two bytes, by the length in the second
_MASKING_KEY = 4  # bytes


class FrameHeads:
    """Follows the heads of frames (RFC 6455 5.2) through the bytes of one client."""

    def __init__(self) -> None:
        self._incomplete = b""  # head at the end of the last bytes
        self._payload_left = 0  # bytes of the last frame
        self._fragments = 0  # of the last message
        self._controls = RateLimiter(MAX_CONTROL_RATE, clock=asyncio.get_running_loop().time)

    def accept(self, data: bytes) -> bool:
        """Whether all frames that begin in the next bytes are allowed.

        They are masked, as RFC 6455 5.1 demands, control frames come at a bounded rate, and
        fragments of a message in a bounded number: the size of empty ones is no bound.
        """
        data, at = self._incomplete + data, self._payload_left
        while at + 1 < len(data):
            is_final, is_control = data[at] & 0x80, data[at] & 0x08
            is_masked, length = data[at + 1] & 0x80, data[at + 1] & 0x7F
            start = at + 2
            end = start + _LENGTH_BYTES.get(length, 0)
            if end > len(data):
                break
            if not is_control:
                self._fragments = 0 if is_final else self._fragments + 1
            has_rate = not is_control or self._controls.take()
            if not is_masked or self._fragments > MAX_FRAGMENTS or not has_rate:
                return False
            at = end + _MASKING_KEY + int.from_bytes(data[start:end] or bytes([length]), "big")
        self._incomplete = data[at:]
        self._payload_left = max(0, at - len(data))
        return True
