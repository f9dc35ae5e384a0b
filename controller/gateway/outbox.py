"""Frames waiting to be sent to one browser: bounded, however slowly it reads."""

import asyncio
from collections import OrderedDict, deque
from typing import TypeAlias

Frame: TypeAlias = str | bytes  # a text or a binary frame of a WebSocket

MAX_RESPONSES = 256
MAX_EVENTS = 256


class Outbox:
    """Responses in order, then events in order, then the latest of each state.

    Of too many events the oldest is dropped; too many responses overflow, and the connection is to
    be closed.
    """

    def __init__(self) -> None:
        self._is_overflowing = False
        self._responses: deque[Frame] = deque()
        self._events: deque[Frame] = deque(maxlen=MAX_EVENTS)
        self._latest: OrderedDict[str, Frame] = OrderedDict()
        self._filled = asyncio.Event()

    def respond(self, frame: Frame) -> None:
        """Add a response."""
        if len(self._responses) >= MAX_RESPONSES:
            self._is_overflowing = True
        else:
            self._responses.append(frame)
        self._filled.set()

    def event(self, frame: Frame) -> None:
        """Add an event."""
        self._events.append(frame)
        self._filled.set()

    def state(self, name: str, frame: Frame) -> None:
        """Replace what is waiting under a name."""
        self._latest[name] = frame
        self._filled.set()

    async def next(self) -> Frame:
        """Wait for the next frame to send; raises OverflowError for too many responses."""
        while True:
            if self._is_overflowing:
                raise OverflowError("the client does not read its responses")
            if self._responses:
                return self._responses.popleft()
            if self._events:
                return self._events.popleft()
            if self._latest:
                return self._latest.popitem(last=False)[1]
            self._filled.clear()
            await self._filled.wait()
