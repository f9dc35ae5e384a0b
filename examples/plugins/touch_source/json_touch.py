"""Touches as JSON over UDP: [[1, 0.25, 0.5], ...], id, x and y of each finger that is down.

x and y are 0 to 1 from the top left corner. The sender repeats its datagram every 50 ms while a
finger is down, and sends [] when the last one lifts; after 150 ms without one all fingers lift.
"""

import asyncio
import json
from collections.abc import Callable

from era_haptics.plugins.touch_sources import (
    InputError,
    Touch,
    TouchFrame,
    TouchSource,
    listen,
)

MAX_SIZE = 4096  # bytes of a datagram; ten fingers need 400


class JsonTouch(TouchSource):
    """A source that listens at jsontouch:HOST:PORT."""

    def __init__(self, url: str) -> None:
        host, _, port = url.removeprefix("jsontouch:").rpartition(":")
        if not host or not (port.isascii() and port.isdecimal() and 0 < int(port) < 65536):
            raise InputError(f"touch source {url}: write jsontouch:HOST:PORT")
        self._host, self._port = host, int(port)

    async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
        """Deliver a frame for each datagram until cancelled; malformed ones are counted."""

        def received(data: bytes, peer: tuple[str, int], arrived: float) -> None:
            try:
                touches = tuple(Touch(int(id), float(x), float(y)) for id, x, y in json.loads(data))
            except (ValueError, TypeError, OverflowError, RecursionError) as error:
                self.rejects.count("malformed", f"datagram from {peer[0]}: {error}")
                return
            deliver(TouchFrame(f"{peer[0]}:{peer[1]}", arrived, touches))

        try:
            line = await listen(self._host, self._port, received, max_size=MAX_SIZE)
        except OSError as error:
            raise InputError(
                f"jsontouch: cannot listen on {self._host}:{self._port} ({error.strerror}); "
                "name another port, or stop the program that has it"
            ) from error
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            line.close()
