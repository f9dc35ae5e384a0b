"""A touch stream that was recorded: fingers come, move and go, and what each change asks for."""

import asyncio
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from controller.sources.capture import RecordedDatagram, read_capture, write_capture
from controller.sources.touch import Touch, TouchFrame
from controller.sources.tuio import tuio_datagram

LENGTH, WIDTH = 12 * 0.0254, 9 * 0.0254  # m; the example's plate
FRAME = 1 / 60  # s; as touch tables send
Place = tuple[float, float]


@dataclass(frozen=True)
class Situation:
    """What is so from one change of the fingers to the next [s] of the stream.

    fingers: places by id, in order of arrival; target: the id of the one to feel it, None where
    no finger is there; from_rest: whether the plate was silent before.
    """

    begin: float
    end: float
    fingers: Mapping[int, str]
    target: int | None
    from_rest: bool

    @property
    def quiet(self) -> tuple[str, ...]:
        """Where nothing may be felt."""
        return tuple(place for id, place in self.fingers.items() if id != self.target)

    @property
    def felt_at(self) -> str:
        """Where it is to be felt."""
        assert self.target is not None
        return self.fingers[self.target]


@dataclass(frozen=True)
class Stream:
    """Places [m] by name, and who is where from when [s] on; the last change ends it."""

    places: Mapping[str, Place]
    changes: Sequence[tuple[float, Mapping[int, str]]]

    @property
    def situations(self) -> list[Situation]:
        """Each change with what it asks for: the finger that came last feels it."""
        found = []
        before: Mapping[int, str] = {}
        for (begin, fingers), (end, _) in pairwise(self.changes):
            target = max(fingers, default=None)  # ids are given in order of arrival
            found.append(Situation(begin, end, fingers, target, not before))
            before = fingers
        return found

    def write(self, path: Path) -> None:
        """As a capture of what a touch table sends."""
        datagrams = []
        end = self.changes[-1][0]
        for number in range(round(end / FRAME) + 1):
            now = number * FRAME
            down = [fingers for begin, fingers in self.changes if begin <= now + 1e-9][-1:]
            touches = tuple(
                Touch(id, self.places[name][0] / LENGTH, 1 - self.places[name][1] / WIDTH)
                for id, name in (down[0] if down else {}).items()
            )
            frame = TouchFrame("table", now, touches)
            datagrams.append(RecordedDatagram(now, tuio_datagram(frame, number + 1)))
        write_capture(path, datagrams)


async def play_stream(
    capture: Path, stream: Stream, port: int, changed: Callable[[float, Mapping[int, str]], None]
) -> None:
    """Send a capture to a UDP port at its own pace.

    changed: called for each before it is sent, with its time on time.monotonic() [s].
    """
    due = list(stream.changes)
    loop = asyncio.get_running_loop()
    transport, _ = await loop.create_datagram_endpoint(
        asyncio.DatagramProtocol, remote_addr=("127.0.0.1", port)
    )
    try:
        start = time.monotonic()
        for datagram in read_capture(capture):
            await asyncio.sleep(max(0.0, start + datagram.time - time.monotonic()))
            while due and due[0][0] <= datagram.time + 1e-6:
                changed(time.monotonic(), due.pop(0)[1])
            transport.sendto(datagram.payload)
    finally:
        transport.close()
