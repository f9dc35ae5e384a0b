"""A port of CAN frames on one of text, as serial adapters and servers have it."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Protocol, final

from drivers.codec.can_bus.canopen import CanFrame
from drivers.codec.can_bus.segments import pack_frames, unpack_frames
from drivers.errors import LinkError
from drivers.hardware import Port


class _Reader(Protocol):
    """Frames from an adapter's text."""

    def feed(self, data: bytes) -> Iterator[CanFrame]:
        """Yield complete frames."""


@final
class TextPort:
    """A port of frames on one of text, below; implements `Port`.

    text_of: a frame as the adapter takes it; on_data: called with packed frames; cut_off: ends a
    line of which a port that was blocked has dropped the rest; goodbye: sent before it is closed.
    """

    def __init__(
        self,
        reader: _Reader,
        text_of: Callable[[CanFrame], bytes],
        on_data: Callable[[bytes], None],
        cut_off: bytes = b"",
        goodbye: bytes = b"",
    ) -> None:
        self._reader, self._text_of, self._on_data = reader, text_of, on_data
        self._cut_off, self._goodbye = cut_off, goodbye
        self.below: Port  # set once open

    @property
    def is_blocked(self) -> bool:
        """Whether it has not taken all bytes yet."""
        return self.below.is_blocked

    def write(self, data: bytes) -> None:
        """Send frames; raises LinkError."""
        text = b"".join(map(self._text_of, unpack_frames(data)))
        self.below.write(self._cut_off + text if self.below.is_blocked else text)

    def poll(self) -> None:
        """Hand over what has come and was not read yet."""
        self.below.poll()

    def close(self) -> None:
        """Close it; no callback is called afterwards."""
        if self._goodbye:
            with contextlib.suppress(LinkError):  # of a lost adapter
                self.below.write(self._goodbye)
        self.below.close()

    async def wait_closed(self) -> None:
        """Wait until it is closed."""
        await self.below.wait_closed()

    def received(self, data: bytes) -> None:
        """Take text of the adapter."""
        if frames := pack_frames(self._reader.feed(data)):
            self._on_data(frames)
