"""A far end on a pseudo terminal that answers as a test scripts it."""

import asyncio
import contextlib
import os
import pty
import tty
from collections.abc import Callable

from drivers.codec.serial_line.exchanges import decode_request, encode_reply
from drivers.codec.serial_line.frame import Frame, FrameReader, encode_frame
from drivers.protocol.messages import (
    Achieved,
    AmplifierState,
    Apply,
    Capabilities,
    Commit,
    Fault,
    FaultList,
    GetCaps,
    GetFaults,
    Hello,
    Identity,
    Reply,
    Request,
    Stage,
    Status,
)

IDENTITY = Identity("Acme", "Quad", "A-17", "1.2", 1)
CAPABILITIES = Capabilities(4, 20.0, 600.0, 0.01, 1.0, 0.0001, 0.01, 1.0, 0.1, 2.0, 0)
STATUS = Status(AmplifierState.OPERATION_ENABLED, Fault.NONE, 0, True, 25.0, 0.25, (0.0,) * 4)


def usual_answer(request: Request) -> Reply:
    """What a well-behaved amplifier says, as far as these tests care."""
    match request:
        case Hello():
            return IDENTITY
        case GetCaps():
            return CAPABILITIES
        case GetFaults():
            return FaultList(())
        case Stage(command_set=wanted) | Apply(command_set=wanted):
            return Achieved(wanted.token, wanted.commands)
        case Commit(token=token):
            return Achieved(token, ())
        case _:
            return STATUS


class FarEnd:
    """The master side of a pty. answer(request, frame) gives bytes or a reply; None is silence."""

    def __init__(self) -> None:
        self.master, self.slave = pty.openpty()
        tty.setraw(self.slave)
        self.path = os.ttyname(self.slave)
        self.url = f"serial://{self.path}"
        self.requests: list[Request] = []
        self.frames: list[Frame] = []
        self.answer: Callable[[Request, Frame], Reply | bytes | None] = lambda request, frame: (
            usual_answer(request)
        )
        self._reader = FrameReader()
        self._arrived = asyncio.Event()
        os.set_blocking(self.master, False)
        asyncio.get_running_loop().add_reader(self.master, self._read)

    def _read(self) -> None:
        for frame in self._reader.feed(os.read(self.master, 4096)):
            request = decode_request(frame)
            self.frames.append(frame)
            self.requests.append(request)
            self._arrived.set()
            answer = self.answer(request, frame)
            if answer is not None:
                self.send(answer, frame)

    def send(self, answer: Reply | bytes, frame: Frame) -> None:
        """Bytes as they are, or a reply to this request frame."""
        if not isinstance(answer, bytes):
            answer = encode_frame(encode_reply(answer, frame))
        os.write(self.master, answer)

    async def count(self, number: int) -> None:
        """Wait until so many requests have come."""
        async with asyncio.timeout(5):
            while len(self.requests) < number:
                self._arrived.clear()
                await self._arrived.wait()

    def unplug(self) -> None:
        """Close the master: for the host the adapter is gone."""
        asyncio.get_running_loop().remove_reader(self.master)
        os.close(self.master)
        self.master = -1

    def close(self) -> None:
        """Give the descriptors back."""
        if self.master >= 0:
            self.unplug()
        with contextlib.suppress(OSError):
            os.close(self.slave)
