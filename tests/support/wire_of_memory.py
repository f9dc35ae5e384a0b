"""A transport of memory, whose other end reads nothing."""

import asyncio
import json
from typing import Any


class Wire(asyncio.Transport):
    """Transport of a client that reads nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.waiting = b""
        self.is_aborted = False
        self.is_read = True

    def lines(self) -> list[dict[str, Any]]:
        """Take the lines that were written, as JSON."""
        lines, self.waiting = self.waiting.splitlines(), b""
        return [json.loads(line) for line in lines]

    def is_closing(self) -> bool:
        """Whether it was closed."""
        return self.is_aborted

    def resume_reading(self) -> None:
        """Note it."""
        self.is_read = True

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Keep the data as unread."""
        self.waiting += bytes(data)

    def get_write_buffer_size(self) -> int:
        """Size of the unread data."""
        return len(self.waiting)

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        """Do nothing."""

    def pause_reading(self) -> None:
        """Note it."""
        self.is_read = False

    def abort(self) -> None:
        """Close."""
        self.is_aborted = True

    close = abort
