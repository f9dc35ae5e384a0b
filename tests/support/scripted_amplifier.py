"""A far end on a pseudo-terminal with scripted replies."""

import asyncio
import contextlib
import os
import pty
import tty
from collections.abc import Callable
from dataclasses import replace

from drivers.codec.serial_line.exchanges import decode_request, encode_reply
from drivers.codec.serial_line.frame import Frame, FrameReader, encode_frame
from drivers.protocol.messages import Reply, Request, Status, Stop
from vendor_pages import usual_reply


class FarEnd:
    """The far side of a pty; `answer` returns bytes or a reply, None for no reply."""

    def __init__(self) -> None:
        self.master, self.slave = pty.openpty()
        tty.setraw(self.slave)
        self.path = os.ttyname(self.slave)
        self.url = f"serial://{self.path}"
        self.requests: list[Request] = []
        self.frames: list[Frame] = []
        self.answer: Callable[[Request, Frame], Reply | bytes | None] = lambda request, _: (
            self.usual_reply(request)
        )
        self._reader = FrameReader()
        self._arrived = asyncio.Event()
        os.set_blocking(self.master, False)
        asyncio.get_running_loop().add_reader(self.master, self._read)

    def usual_reply(self, request: Request) -> Reply:
        """Reply as an amplifier that plays nothing and numbers its stops."""
        reply, stops = usual_reply(request), sum(isinstance(one, Stop) for one in self.requests)
        return replace(reply, latch=stops) if isinstance(reply, Status) else reply

    def _read(self) -> None:
        self.receive(os.read(self.master, 4096))

    def write(self, data: bytes) -> None:
        """Send bytes to the host; another way than the pty's may take its place."""
        os.write(self.master, data)

    def receive(self, data: bytes) -> None:
        """Reply to what has arrived."""
        for frame in self._reader.feed(data):
            request = decode_request(frame)
            self.frames.append(frame)
            self.requests.append(request)
            self._arrived.set()
            answer = self.answer(request, frame)
            if answer is not None:
                self.send(answer, frame)

    def send(self, answer: Reply | bytes, frame: Frame) -> None:
        if not isinstance(answer, bytes):
            answer = encode_frame(encode_reply(answer, frame))
        self.write(answer)

    async def count(self, number: int) -> None:
        async with asyncio.timeout(60):
            while len(self.requests) < number:
                self._arrived.clear()
                await self._arrived.wait()

    def unplug(self) -> None:
        asyncio.get_running_loop().remove_reader(self.master)
        os.close(self.master)
        self.master = -1

    def close(self) -> None:
        if self.master >= 0:
            self.unplug()
        with contextlib.suppress(OSError):
            os.close(self.slave)
