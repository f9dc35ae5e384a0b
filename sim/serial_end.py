"""The amplifier's side of a serial line: a pseudo-terminal in front of a simulated amplifier.

Not modelled: the speed of the line (a pseudo-terminal carries bytes at once, whatever baud rate is
set), noise, parity. The amplifier has the address that one has by default and is deaf to others.
"""

import asyncio
import os
import tty

from drivers.errors import LinkError
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import Nak, Reply, Request
from drivers.protocol.payload import Malformed
from drivers.protocol.serial_codec import decode_request, encode_reply
from drivers.protocol.serial_frame import Frame, FrameCounters, FrameReader, encode_frame
from sim.real_time import Exchange

_READ_MAX = 4096


class SerialEnd:
    """A pseudo-terminal on which an amplifier answers; its requests go to `exchange`."""

    def __init__(self, exchange: Exchange) -> None:
        self._exchange = exchange
        self._reader = FrameReader()
        self.dropped_replies = 0
        try:
            self._master, self._slave = os.openpty()
        except OSError as error:
            raise LinkError(
                f"the system gives no pseudo-terminal ({error.strerror}); close programs that hold "
                "some, or raise their number"
            ) from error
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        # The slave stays open here, so that a host may come and go without a hang-up.
        self.url = f"serial://{os.ttyname(self._slave)}?baud={PROTOCOL.serial.baud}"

    @property
    def counters(self) -> FrameCounters:
        """What came in, frames by their fate."""
        return self._reader.counters

    def start(self) -> None:
        """Answer from now on, in the running event loop."""
        asyncio.get_running_loop().add_reader(self._master, self._readable)

    def close(self) -> None:
        """Hang up; to be called in the event loop that it was started in."""
        asyncio.get_running_loop().remove_reader(self._master)
        os.close(self._master)
        os.close(self._slave)

    def _readable(self) -> None:
        try:
            data = os.read(self._master, _READ_MAX)
        except BlockingIOError:  # another wake-up took the bytes
            return
        for frame in self._reader.feed(data):
            # Broadcasts have no reply and nothing here needs one; an echo is no request.
            if frame.address == PROTOCOL.serial.address and not frame.is_reply:
                self._write(encode_reply(self._answer(frame), frame))

    def _answer(self, frame: Frame) -> Reply:
        try:
            request: Request = decode_request(frame)
        except Malformed as problem:
            return Nak(problem.code, problem.channel)
        return self._exchange(request)

    def _write(self, frame: Frame) -> None:
        data = encode_frame(frame)
        try:
            complete = os.write(self._master, data) == len(data)
        except BlockingIOError:
            complete = False
        if not complete:  # nobody reads; an amplifier does not wait for its host
            self.dropped_replies += 1
