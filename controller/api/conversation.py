"""One client's connection to a daemon without any I/O: calls into lines, bytes into replies."""

from typing import Any

from controller.api.calls import Call
from controller.api.client_protocol import Reply, reply_of
from controller.api.jsonrpc import request_line

RESPONSE_TIMEOUT = 5.0  # s; arming takes the longest, some tenths of a second
MAX_QUEUED_EVENTS = 1000  # that wait to be looked at; older ones are dropped
CHUNK = 1 << 16  # bytes; as many are read at a time


class Conversation:
    """Numbers the requests, and puts the daemon's bytes together to what it says."""

    def __init__(self) -> None:
        self._number = 0
        self._rest = b""

    def ask(self, call: Call[Any]) -> tuple[int, bytes]:
        """The number of a request, which its answer will have, and the line to send."""
        self._number += 1
        return self._number, request_line(self._number, call.method, call.params)

    def hear(self, data: bytes) -> list[Reply]:
        """What has been said by now; raises Unreachable for what no daemon would say."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        return [reply_of(line) for line in lines]
