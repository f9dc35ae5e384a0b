"""What is to be sent to one browser: bounded, however slowly it reads."""

import asyncio
from collections import OrderedDict, deque
from typing import TypeAlias

Frame: TypeAlias = str | bytes  # a text or a binary frame of a WebSocket

MOST_ANSWERS = 256
MOST_EVENTS = 256


class Outbox:
    """Answers in order, events in order, and of everything that changes all the time the newest.

    Answers go first. Where more wait than is allowed, the oldest event is lost; too
    many answers overflow: their reader asks faster than it reads, and is to be left.
    """

    def __init__(self) -> None:
        self.is_overflowing = False
        self._answers: deque[Frame] = deque()
        self._events: deque[Frame] = deque(maxlen=MOST_EVENTS)
        self._newest: OrderedDict[str, Frame] = OrderedDict()
        self._filled = asyncio.Event()

    def answer(self, frame: Frame) -> None:
        """What was asked for."""
        if len(self._answers) >= MOST_ANSWERS:
            self.is_overflowing = True
        else:
            self._answers.append(frame)
        self._filled.set()

    def event(self, frame: Frame) -> None:
        """What happened."""
        self._events.append(frame)
        self._filled.set()

    def state(self, name: str, frame: Frame) -> None:
        """What is so now, in place of what was so under this name."""
        self._newest[name] = frame
        self._filled.set()

    async def next(self) -> Frame:
        """Wait for the next frame to send; raises OverflowError when answers pile up."""
        while True:
            if self.is_overflowing:
                raise OverflowError("this client does not read the answers to what it asks")
            if self._answers:
                return self._answers.popleft()
            if self._events:
                return self._events.popleft()
            if self._newest:
                return self._newest.popitem(last=False)[1]
            self._filled.clear()
            await self._filled.wait()
